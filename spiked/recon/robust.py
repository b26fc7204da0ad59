"""The middle of a few hundred numbers, which every view asks for half a dozen times."""

import numpy as np

from spiked.pose import Array


def median(values: Array) -> float:
    """Of [n > 0] numbers without NaN: `np.median` takes five times as long to look for axes and NaN as to sort."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    around = np.partition(values, (middle - 1, middle))
    return 0.5 * float(around[middle - 1] + around[middle])
