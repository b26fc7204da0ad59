"""Host time of frames, from the times at which they were seen to arrive.

A busy host sees a frame late and never early. The line frame -> time of a camera with a constant rate therefore lies
below all points (frame, time seen) and touches those seen without delay. Their lower convex hull says which points
those are. A single one may be early, by a frame where a transfer ends with one, so the line goes through the earliest
points of many windows: its rate by least squares, its height by their median.
"""

import statistics
import time
from collections import deque
from itertools import chain

_WINDOW_NS = 250_000_000
"""Length of a window, ns; the line is fitted anew after each."""
_SLOPE_WINDOWS = 32
"""Windows for the rate: 8 s."""
_OFFSET_WINDOWS = 16
"""Windows for the offset, 4 s: the clocks of camera and host drift, so older delays do not count."""
_SETTLED_NS = 4_000_000_000
"""Below this span, ns, a stated rate that fits the points is used instead of the measured one."""
_LEAST_SPAN_NS = 500_000_000
"""Below this span, ns, the stated rate is used in any case."""
_RATE_TOLERANCE = 0.005
"""Relative deviation from the stated rate that is accepted..."""
_DELAY_NS = 20_000_000
"""... plus this delay of a busy host divided by the span, ns."""
_PUNCTUAL_NS = 500_000
"""Largest distance above the line of a point seen without delay, ns."""
_UNTIMELY = 2
"""Windows whose earliest point may be too early."""
_LEAST_FITTED = 8
"""Windows without delay that a rate by least squares needs, 2 s."""
_REFINEMENTS = 4
"""Iterations of the slope; it converges in two or three."""

Point = tuple[int, int]
"""Frame and time in ns, relative to the first point of the line."""


class FrameClock:
    """Line from frame index to host time, fitted four times a second.

    Unix times are monotonic times plus the difference at the start: setting the clock during a capture has no effect.
    """

    def __init__(self, rate_hz: float) -> None:
        self._stated_ns = 1e9 / rate_hz
        self._unix_ns = time.time_ns() - time.monotonic_ns()
        self._windows: deque[list[Point]] = deque(maxlen=_SLOPE_WINDOWS)
        self._window: list[Point] = []
        self._origin: Point | None = None
        self._closes_ns = 0
        self._slope_ns = self._stated_ns
        self._offset_ns: float | None = None
        self._span_ns = 0
        self._measured_ns: float | None = None

    @property
    def settled(self) -> bool:
        """Whether the line spans enough time for a measured rate."""
        return self._span_ns >= _SETTLED_NS

    @property
    def first_frame(self) -> int | None:
        """First frame of the line; None before there is one."""
        return None if self._origin is None else self._origin[0]

    def restart(self) -> None:
        """The frame count was interrupted: earlier points are not valid any more."""
        self._windows.clear()
        self._window = []
        self._origin = self._offset_ns = None
        self._span_ns = 0

    def arrived(self, frame: int, seen_ns: int) -> bool:
        """All frames up to `frame` had arrived at this monotonic time. Returns whether the line was fitted anew."""
        if self._origin is None:
            self._origin = frame, seen_ns
            self._closes_ns = seen_ns + _WINDOW_NS
        point = frame - self._origin[0], seen_ns - self._origin[1]
        _extend(self._window, point)
        return seen_ns >= self._closes_ns and self.fit(seen_ns)

    def fit(self, now_ns: int) -> bool:
        """Fit the line to all points of the windows; false if there are none."""
        self._closes_ns = now_ns + _WINDOW_NS
        if self._window:
            self._windows.append(self._window)
            self._window = []
        if not self._windows:
            return False
        hull: list[Point] = []
        for point in chain.from_iterable(self._windows):
            _extend(hull, point)
        self._span_ns = hull[-1][1] - hull[0][1]
        self._measured_ns = _slope_ns(hull) if self._span_ns >= _LEAST_SPAN_NS else None
        self._slope_ns = self._measured_ns or self._stated_ns
        if not self.settled and self.wrong_rate() is None:
            self._slope_ns = self._stated_ns
        elif self._measured_ns is not None:
            self._measured_ns = self._slope_ns = _fitted_slope_ns(self._earliest(_SLOPE_WINDOWS), self._slope_ns)
        early = self._earliest(_OFFSET_WINDOWS)
        self._offset_ns = statistics.median(seen - self._slope_ns * frame for frame, seen in early)
        return True

    def _earliest(self, windows: int) -> list[Point]:
        """The earliest point of each of the last windows by the present rate, without delayed and untimely ones."""
        found = [
            min(window, key=lambda point: point[1] - self._slope_ns * point[0])
            for window in list(self._windows)[-windows:]
        ]
        delays = [seen - self._slope_ns * frame for frame, seen in found]
        usual = sorted(delays)[min(_UNTIMELY, len(delays) // 4)]
        return [point for point, delay in zip(found, delays, strict=True) if abs(delay - usual) <= _PUNCTUAL_NS]

    def unix_ns(self, frame: int) -> int | None:
        """Unix time in ns at which the frame had arrived whole, by the last line; None before there is one."""
        if self._offset_ns is None or self._origin is None:
            return None
        seen_ns = self._origin[1] + self._offset_ns + self._slope_ns * (frame - self._origin[0])
        return self._unix_ns + round(seen_ns)

    def wrong_rate(self) -> float | None:
        """The measured rate in frames a second if it differs from the stated one beyond its error; else None."""
        if self._measured_ns is None:
            return None
        off = abs(self._measured_ns / self._stated_ns - 1)
        return 1e9 / self._measured_ns if off > _RATE_TOLERANCE + _DELAY_NS / self._span_ns else None


def _slope_ns(hull: list[Point]) -> float | None:
    """Nanoseconds a frame: first of the hull's edge at the middle of the time, then of its outermost punctual points.

    The hull's ends alone may be late: a capture may start with frames that the camera kept for seconds.
    """
    middle_ns = (hull[0][1] + hull[-1][1]) / 2
    high = next(at for at, (_, seen) in enumerate(hull) if at and seen >= middle_ns)
    low = high - 1
    for _ in range(_REFINEMENTS):
        (first, begin_ns), (last, end_ns) = hull[low], hull[high]
        slope_ns = (end_ns - begin_ns) / (last - first)
        delays = [seen - slope_ns * frame for frame, seen in hull]
        least = min(delays)
        punctual = [at for at, delay in enumerate(delays) if delay - least <= _PUNCTUAL_NS]
        low, high = min(low, punctual[0]), max(high, punctual[-1])
    (first, begin_ns), (last, end_ns) = hull[low], hull[high]
    return (end_ns - begin_ns) / (last - first) if end_ns > begin_ns else None


def _fitted_slope_ns(early: list[Point], known_ns: float) -> float:
    """Nanoseconds a frame by least squares; as known with too few points, or if they are not spread."""
    if len(early) < _LEAST_FITTED:
        return known_ns
    slope, _ = statistics.linear_regression(*zip(*early, strict=True))
    return float(slope) if slope > 0 else known_ns


def _extend(hull: list[Point], point: Point) -> None:
    """Add a point with the largest frame so far to a lower convex hull (monotone chain)."""
    frame, seen = point
    if hull and hull[-1][0] == frame:
        return
    while len(hull) > 1:
        (x0, y0), (x1, y1) = hull[-2], hull[-1]
        if (x1 - x0) * (seen - y0) > (y1 - y0) * (frame - x0):
            break
        hull.pop()
    hull.append(point)
