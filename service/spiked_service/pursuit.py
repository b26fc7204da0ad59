"""How a tracker follows a camera that is faster: it looks at the newest frames, and passes over those in between.

Nothing is lost by it. The frames are recorded, and the reconstruction begins again from the recording with all of them.
"""

import numpy as np
from numpy.typing import NDArray

from spiked.ring import End, Frames, Gap, RingReader

LATE_FRAMES = 2000
"""Further behind than this, a tracker will not catch up by taking every frame: they are seconds of its work, however
long the camera took for them. A capture of fewer is followed whole."""
_REACH_PX = (20.0, 60.0)
"""Tracks hold over the first image motion from one glance to the next, and mostly over the second."""
_STRIDE_S = 0.05
"""The motion is foreseen for about so long."""
_BOLD_S = 0.2
"""The later it is, the more is dared; so late, the second reach: a late pose is of no more use than a lost one."""


def next_glance(at: int, newest: int, count: int, speed_px: float | None, rate_hz: float) -> int:
    """First of `count` frames to look at: the newest before `newest`, if the tracks hold so far from frame `at`.

    `speed_px` is the image motion a frame, None where nobody knows.
    """
    latest = newest - count
    if speed_px:
        late_s = max(latest - at, 0) / rate_hz
        reach_px = np.interp(late_s, (0, _BOLD_S), _REACH_PX)
        latest = min(latest, int(at + min(reach_px / speed_px, max(_STRIDE_S, late_s / 2) * rate_hz)))
    return max(at, latest)


class Glances:
    """Collects the frames of one glance after the other from a ring, in which all others are passed over."""

    def __init__(self, reader: RingReader, at: int) -> None:
        """Go on at frame `at`."""
        self._reader = reader
        self._parts: list[NDArray[np.uint8]] = []
        self._first = self._wanted = at
        self._count = 0
        self.at = at
        """The frame that comes next."""
        self.passed = 0
        """Frames that were looked at by nobody."""

    def look_at(self, first: int, count: int) -> None:
        """Collect these from now on; what was collected before and not taken is passed over."""
        self.passed += sum(len(part) for part in self._parts)
        self._parts, self._wanted, self._count = [], max(first, self.at), count

    def take(self, wait_s: float) -> tuple[int, NDArray[np.uint8]] | Gap | End | None:
        """The frames that were to be looked at, with the index of the first; a gap or the end, if that comes before;
        None if they do not come in time."""
        while (item := self._reader.next(wait_s)) is not None:
            if not isinstance(item, Frames):
                self.look_at(self._wanted, self._count)
                self.at = item.first + item.count if isinstance(item, Gap) else self.at
                return item
            stop = item.first + item.count
            wanted = stop > self._wanted
            copied = np.array(item.data) if wanted else None
            if not item.release():
                continue  # the next item tells
            self.at = stop
            if copied is None:
                self.passed += item.count
                continue
            if not self._parts:
                self._first = item.first
            self._parts.append(copied)
            if stop - self._first >= self._count:
                frames, self._parts = np.concatenate(self._parts), []
                return self._first, frames
        return None
