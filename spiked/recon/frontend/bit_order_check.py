"""Checks the stated order of the bits in a byte against the pixels of a recording."""

import numpy as np

from spiked.sensor import BitOrder, Image

BORDER_RATIO = 1.3
"""Ratio of `border_ratio` above which the order is wrong: four simulated and two real recordings have at most 1.07 in
the right order and at least 1.55 in the wrong one, from 16 frames."""
APART = 2
"""Columns between the pixels that are compared: of a mosaic the same sites."""


def border_ratio(rate: Image) -> float:
    """Difference of pixels two columns apart across the border of two bytes, over that within a byte.

    `rate` [H, W] is upright. In the wrong order, pixels across a border are 14 columns apart in truth.
    """
    steps = np.abs(rate[:, APART:] - rate[:, :-APART]).mean(0)
    across = np.arange(len(steps)) % 8 >= 8 - APART
    if across.all() or not across.any():
        return 1.0
    return float(steps[across].mean() / max(float(steps[~across].mean()), 1e-9))


def bit_order_warning(stated: BitOrder, rate: Image) -> str | None:
    """A warning where the pixels [H, W] contradict the stated order."""
    if border_ratio(rate) < BORDER_RATIO:
        return None
    other = BitOrder.MSB if stated is BitOrder.LSB else BitOrder.LSB
    return (
        f"by its pixels the bits of each byte come {other} first, not {stated} first: columns are out of order, and "
        f"no path will be found; give --bit-order {other}, or correct the sidecar's bit_order"
    )
