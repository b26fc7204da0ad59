"""Host time of frames between the clock pairs of a recording."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.recording.sidecar import ClockPair

_LEAST_NS = 500_000_000
"""Pairs closer together, ns, determine the rate worse than the sidecar does."""
_ENOUGH_NS = 8_000_000_000
"""Time before and after an end of the pairs whose rate is extrapolated, ns: the window of the acquisition's clock."""


def host_times_ns(pairs: Sequence[ClockPair], frames: ArrayLike, frame_rate_hz: float) -> NDArray[np.int64]:
    """Unix times in ns, int64, at which frames had arrived whole. Same shape as `frames`, which need not be integers.

    Linear between pairs. Outside, extrapolated by the rate of the pairs within eight seconds of that end; if the pairs
    span less than half a second, by the stated rate. Needs at least one pair.
    """
    x = np.array([pair.frame for pair in pairs], np.float64)
    start_ns = pairs[0].unix_ns
    y = np.array([pair.unix_ns - start_ns for pair in pairs], np.float64)
    wanted = np.asarray(frames, np.float64)
    times = np.interp(wanted, x, y)
    times += np.minimum(wanted - x[0], 0) * _slope_ns(x, y, frame_rate_hz)
    times += np.maximum(wanted - x[-1], 0) * _slope_ns(x[::-1], y[::-1], frame_rate_hz)
    return start_ns + np.rint(times).astype(np.int64)


def _slope_ns(x: NDArray[np.float64], y: NDArray[np.float64], frame_rate_hz: float) -> float:
    """Nanoseconds per frame at the start of the arrays."""
    span = np.abs(y - y[0])
    other = int(np.flatnonzero(span <= _ENOUGH_NS)[-1])
    if span[other] < _LEAST_NS:
        return 1e9 / frame_rate_hz
    return float((y[other] - y[0]) / (x[other] - x[0]))
