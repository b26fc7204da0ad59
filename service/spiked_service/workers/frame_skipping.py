"""Skips backlog when tracking cannot keep up with the camera.

The tracker takes windows of the newest frames and skips those between. Skipped frames are not lost: they are recorded,
and the reconstruction runs again from the recording with all frames.
"""

import numpy as np
from numpy.typing import NDArray

from spiked.recon.view_tracking import BRIDGED_S
from spiked.ring import End, Frames, Gap, RingReader

LATE_FRAMES = 2000
"""Backlog, in frames, beyond which the tracker skips: fast motion is tracked at some hundred frames a second.
Captures of fewer frames are tracked completely."""
REACH_PX = (20.0, 40.0, 60.0)
"""Image motion between windows, pixels, of a tracker late by `_LATE_S`: feature tracks survive the first, and most
survive the second; with the third everywhere a view was lost several times a minute in turns (decision 64)."""
_STRIDE_S = 0.05
"""Time over which the motion model predicts, about."""
_LATE_S = (0.0, 0.2, 1.0)
"""Lateness at which each `REACH_PX` applies; in between, the reach is interpolated."""
_BRIDGED_STRIDE_S = 0.95 * BRIDGED_S
"""Longest time from the begin of a window to the end of the next where the path is interpolated between the two."""
_PATIENCE = 0.6
"""Share of the ring's backlog up to which a late tracker skips no more than that: larger strides catch up before the
ring drops frames."""
_WINDOWS_MEANT = 30
"""Windows over which the time that one takes is averaged, about."""
_STEP_S = 0.02
"""Time of a step of the map, about."""
_STEP_REACH_PX, _PUNCTUAL_S = 4.0, 0.04
"""Image motion, and lateness, up to which the tracker waits for a step of the map."""
_SWEEP_REACH_PX = 15.0
"""Image motion behind the camera up to which a sweep for depth begins: it takes some of the cores."""
LONGEST_UNMAPPED_S = 1.0
"""Time after which the map gets a step anyway."""


def may_map(late_frames: int, speed_px: float | None, rate_hz: float) -> bool:
    """Whether a tracker so many frames behind the camera can wait for a step of the map.

    `speed_px` is the image motion in pixels a frame, None if unknown.
    """
    late_s = late_frames / rate_hz
    return late_s < _PUNCTUAL_S and (late_s + _STEP_S) * rate_hz * (speed_px or 0.0) < _STEP_REACH_PX


def may_sweep(late_frames: int, speed_px: float | None) -> bool:
    """Whether a tracker so many frames behind the camera can share the cores with a sweep for depth.

    `speed_px` is the image motion in pixels a frame, None if unknown.
    """
    return speed_px is not None and late_frames * speed_px < _SWEEP_REACH_PX


class WindowChooser:
    """Chooses the windows of a tracker that cannot keep up with the camera."""

    def __init__(self, rate_hz: float, backlog_s: float) -> None:
        """`backlog_s` is how late a reader may be before the ring drops frames."""
        self._rate_hz = rate_hz
        self._patience_s = _PATIENCE * backlog_s
        self._window_s = 0.0

    def took(self, seconds: float) -> None:
        """A window was tracked in this time."""
        self._window_s += (seconds - self._window_s) / _WINDOWS_MEANT

    def next(self, at: int, newest: int, count: int, speed_px: float | None) -> int:
        """First frame of the next window of `count` frames, at or after frame `at`.

        The window ends at `newest` unless the motion from `at` exceeds the reach of the tracks, or the time what is
        bridged. A tracker that cannot keep up without gaps in the path does not try to. `speed_px` is the image
        motion in pixels a frame, None if unknown.
        """
        latest = newest - count
        if speed_px:
            late_s = max(latest - at, 0) / self._rate_hz
            stride_s = max(_STRIDE_S, late_s / 2)
            bridged_s = _BRIDGED_STRIDE_S - count / self._rate_hz
            if late_s < self._patience_s and self._window_s < _BRIDGED_STRIDE_S and bridged_s > 0:
                stride_s = min(stride_s, bridged_s)
            reach_px = np.interp(late_s, _LATE_S, REACH_PX)
            latest = min(latest, int(at + min(reach_px / speed_px, stride_s * self._rate_hz)))
        return max(at, latest)


class LatestFrames:
    """Reads windows of frames from a ring and skips the frames between them."""

    def __init__(self, reader: RingReader, at: int) -> None:
        """Start at frame `at`."""
        self._reader = reader
        self._parts: list[NDArray[np.uint8]] = []
        self._first = self._wanted = at
        self._count = 0
        self.at = at
        """Index of the next frame of the ring."""
        self.skipped = 0
        """Frames that were skipped."""

    @property
    def backlog_frames(self) -> int:
        """How far behind the newest frame may be read before the ring drops frames."""
        return self._reader.backlog_frames

    def track_latest(self, first: int, count: int) -> None:
        """Select the next window. Frames collected for an earlier one and not taken count as skipped."""
        self.skipped += sum(len(part) for part in self._parts)
        self._parts, self._wanted, self._count = [], max(first, self.at), count

    def take(self, wait_s: float) -> tuple[int, NDArray[np.uint8]] | Gap | End | None:
        """The selected window with the index of its first frame, or a gap or the end of the ring that precedes it.

        None if the window is not complete within `wait_s`.
        """
        while (item := self._reader.next(wait_s)) is not None:
            if not isinstance(item, Frames):
                self.track_latest(self._wanted, self._count)
                self.at = item.first + item.count if isinstance(item, Gap) else self.at
                return item
            stop = item.first + item.count
            wanted = stop > self._wanted
            copied = np.array(item.data) if wanted else None
            if not item.release():
                continue  # overwritten: the next item is a gap
            self.at = stop
            if copied is None:
                self.skipped += item.count
                continue
            if not self._parts:
                self._first = item.first
            self._parts.append(copied)
            if stop - self._first >= self._count:
                frames, self._parts = np.concatenate(self._parts), []
                return self._first, frames
        return None
