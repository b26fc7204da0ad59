"""Robust statistics of a few hundred numbers."""

import numpy as np

from spiked.pose import Array

RAYLEIGH_MEDIAN = 1.1774
"""sqrt(2 ln 2): median length of a two-dimensional error over its standard deviation in one direction."""
WHITE_PERCENTILE = 99.5
"""Percentile of an image's rates that is shown as white: a few pixels are lamps, reflections or hot."""


def evenly(length: int, count: int) -> list[int]:
    """At most `count` of the indices of `length` things, evenly spread from the first to the last, ascending."""
    return [int(i) for i in np.unique(np.linspace(0, length - 1, min(count, length)).round())]


def median(values: Array) -> float:
    """Of [n > 0] numbers without NaN: `np.median` takes five times as long to look for axes and NaN as to sort."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    around = np.partition(values, (middle - 1, middle))
    return 0.5 * float(around[middle - 1] + around[middle])
