"""Builds views anew from the frames of a recording: what does not fit into memory is read again."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.calibration import Calibration
from spiked.recon.frontend.motion_compensation import COARSE_FRAMES, MotionCompensator
from spiked.recon.frontend.spike_targets import TargetKind, record_targets
from spiked.recon.frontend.windowing import View, make_view
from spiked.sensor import Image, Sensor


class RecordedFrames(Protocol):
    """Frames that can be read again: those of a `Recording`."""

    def captured(self, first: int, count: int) -> NDArray[np.uint8] | None:
        """Stored frames, uint8 [count, frame_bytes], from index `first` in the capture; None if not all can be read."""


@dataclass(frozen=True)
class ViewFrames:
    """The frames that a view was made of, by index in the capture: all that it takes to build it again."""

    begin: int
    end: int
    """Of the view: frames [begin, end)."""
    first: int
    count: int
    """Frames read, from `first` on."""
    after_gap: bool
    warped: tuple[int, int] | None
    """First and number of `View.frames`; None where the motion is slow."""

    @classmethod
    def of(cls, view: View) -> "ViewFrames":
        """Those of a view."""
        first = round(view.time - view.intervals.middle)
        warped = None if view.frames is None else (view.first, len(view.frames))
        return cls(view.begin, view.end, first, view.intervals.frames, view.after_gap, warped)


@dataclass
class RecordedViews:
    """The views of a recording, built anew from its frames."""

    source: RecordedFrames
    sensor: Sensor
    calibration: Calibration | None = None
    targets: tuple[TargetKind, ...] = ()
    """What each view records for the map."""

    def holds(self, of: ViewFrames) -> bool:
        """Whether all frames of a view can be read."""
        if of.warped is not None and self.source.captured(*of.warped) is None:
            return False
        return self.source.captured(of.first, of.count) is not None

    def build(self, of: ViewFrames, sharp: bool = False) -> View | None:
        """See `build_view`."""
        return build_view(of, self.source, self.sensor, self.calibration, sharp, self.targets)


def build_view(
    of: ViewFrames,
    source: RecordedFrames,
    sensor: Sensor,
    calibration: Calibration | None = None,
    sharp: bool = False,
    targets: tuple[TargetKind, ...] = (),
) -> View | None:
    """The view of these frames, equal to the first one; None if they cannot be read.

    The motion-compensated image is built only with `sharp`, from the motion in the frames read.
    """
    frames = source.captured(of.first, of.count)
    warped = None if of.warped is None else source.captured(*of.warped)
    if frames is None or (of.warped is not None and warped is None):
        return None
    window = aligned_window(frames, sensor, of.first, of.begin, of.end)
    image = _sharp(of, frames, sensor) if sharp and warped is not None else None
    first = 0 if of.warped is None else of.warped[0]
    recorded = record_targets(targets, frames, sensor, of.first, of.begin, of.end)
    return make_view(window, sensor, of.after_gap, calibration, image, first, warped, recorded)


def _sharp(of: ViewFrames, frames: NDArray[np.uint8], sensor: Sensor) -> Image | None:
    """The motion-compensated image [H, W] of a view of fast motion; None if the motion around it is unknown."""
    time, interval = 0.5 * (of.begin + of.end), of.end - of.begin
    before = (time - of.first - max(COARSE_FRAMES, interval) // 2) // interval
    compensator = MotionCompensator(sensor, interval)
    compensator.estimate(frames, of.first, time - max(before, 0) * interval)
    return compensator.sharp(frames, of.first, time)
