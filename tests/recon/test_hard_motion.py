"""Days on which the camera moves as no one would like: each ends with the right path, or says why not."""

from dataclasses import dataclass

import numpy as np
import pytest
import staging
from numpy.typing import ArrayLike
from staging import SENSOR

from spiked.recon import Reconstructor, State
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.motion import Array, Motion, StandThenMove, make_motion
from spiked.simulate.room import Room


def path(kind: MotionKind = MotionKind.ARC, seed: int = 2) -> Motion:
    assert SENSOR.intrinsics is not None
    return make_motion(kind, Room(False, seed).stage(SENSOR.intrinsics, 0.3, 0.5), seed)


@dataclass(frozen=True)
class Halting:
    """A path on which the camera stops dead at `stop` and goes on at `go`."""

    base: Motion
    stop: float
    go: float

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        times = np.atleast_1d(np.asarray(frames, np.float64))
        return self.base.poses(np.minimum(times, self.stop) + np.maximum(times - self.go, 0))


@dataclass(frozen=True)
class After:
    """One path for `until` frames, then another from where that ended."""

    first: Motion
    until: float
    second: Motion

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        times = np.atleast_1d(np.asarray(frames, np.float64))
        rotations, centres = self.first.poses(np.minimum(times, self.until))
        (r0,), (c0,) = self.first.poses([self.until])
        (s0,), (d0,) = self.second.poses([0.0])
        r, d = self.second.poses(np.maximum(times - self.until, 0))
        late = times > self.until
        turn = r0 @ s0.T
        return np.where(late[:, None, None], turn @ r, rotations), np.where(
            late[:, None], c0 + (d - d0) @ turn.T, centres
        )


@dataclass(frozen=True)
class Bursting:
    """A path on which the camera moves `times` as fast for `frames` frames from `begin` on."""

    base: Motion
    begin: float
    frames: float
    times: float

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        now = np.atleast_1d(np.asarray(frames, np.float64))
        return self.base.poses(now + (self.times - 1) * np.clip(now - self.begin, 0, self.frames))


def followed(motion: Motion, count: int, lost: tuple[int, int] | None = None) -> tuple[Reconstructor, float, float]:
    """The path without a map, its error in percent and its coverage."""
    return staging.followed(SimulatedCamera(SENSOR, seed=2, motion=motion), count, lost)


@pytest.mark.parametrize("still", [320, 10_000], ids=["a_moment", "half_a_second"])
def test_a_camera_that_stands_still_first(still: int) -> None:
    """The spline once swung between the far views of the still camera: 83 % of error, and no word of it."""
    reconstructor, error, coverage = followed(StandThenMove(path(), still, 64), still + 600)
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    assert error < 3 and coverage > 0.98


@pytest.mark.parametrize(("stop", "go"), [(350, 650), (330, 640)])
def test_a_camera_that_stops_and_goes_on(stop: float, go: float) -> None:
    """The second lost its poses while it stood: an adjustment in between had too few views to follow it."""
    reconstructor, error, coverage = followed(Halting(path(), stop, go), 900)
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    assert error < 3 and coverage > 0.98


def test_a_camera_that_turns_first() -> None:
    """240x160 pixels leave such a path loosely known, which is told."""
    motion = After(path(MotionKind.ROTATION, 3), 400, path())
    reconstructor, error, coverage = followed(motion, 900)
    status = reconstructor.status()
    told = status.state is State.DEGRADED and "shape" in status.reason
    assert error < 6 and coverage > 0.7
    assert told or (status.state is State.TRACK and error < 3), (error, status)
    assert any("sideways" in reason for _, _, reason in reconstructor.odometry.changes)


def test_a_short_gap_leaves_the_path_whole() -> None:
    _, error, coverage = followed(path(), 600, lost=(320, 360))
    assert error < 3 and coverage > 0.9


def test_a_burst_of_six_pixels_a_frame_is_told_and_the_path_goes_on_behind_it() -> None:
    """Half of what was in view is gone after 20 frames, none of which shows more than smears."""
    reconstructor, error, coverage = followed(Bursting(path(), 400, 20, 20), 700)
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    assert error < 3 and 0.9 < coverage < 0.99, (error, coverage)
    changes = reconstructor.odometry.changes
    assert any(state is State.LOST and "too fast" in reason for _, state, reason in changes), changes
    assert any(state is State.RELOC and "found again" in reason for _, state, reason in changes), changes
    times = reconstructor.trajectory().times_s * SENSOR.frame_rate_hz
    assert not ((times > 408) & (times < 416)).any(), "no poses are invented in the burst"


def test_a_recording_that_ends_with_little_parallax_has_a_rough_path() -> None:
    """30 ms of a slow hand, 0.3 px of parallax: a first map of a path that goes on would wait for more."""
    assert SENSOR.intrinsics is not None
    motion = make_motion(MotionKind.ARC, Room(False, 2).stage(SENSOR.intrinsics, 0.03, 0.04), 2)
    reconstructor, error, covered = followed(motion, 600)
    status = reconstructor.status()
    assert status.state is State.DEGRADED and "moved sideways so little" in status.reason
    assert covered == 1 and error < 10, error
