"""Days on which the camera moves as no one would like: each ends with the right path, or says why not."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import ArrayLike

from spiked.evaluate import score_trajectory
from spiked.recon import Options, Reconstructor, State
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.motion import Array, Motion, StandThenMove, make_motion
from spiked.simulate.room import Room
from spiked.trajectory import Trajectory

SENSOR = Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 60))


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


def followed(motion: Motion, count: int, lost: tuple[int, int] | None = None) -> tuple[Reconstructor, float, float]:
    """The path without a map, its error in percent and its coverage."""
    camera = SimulatedCamera(SENSOR, seed=2, motion=motion)
    frames = camera.next_frames(count)
    reconstructor = Reconstructor(SENSOR, Options(steps=0))
    for first in range(0, count, 40):
        if lost is not None and lost[0] <= first < lost[1]:
            if first == lost[0]:
                reconstructor.gap(first, lost[1] - lost[0])
            continue
        reconstructor.feed(first, frames[first : first + 40])
    reconstructor.finish()
    k = np.arange(count)
    truth = Trajectory((k + 0.5) / SENSOR.frame_rate_hz, *camera.truth(k))
    score = score_trajectory(truth, reconstructor.trajectory(), SENSOR.frame_rate_hz)
    return reconstructor, np.inf if score.errors is None else score.errors.ate_percent, score.coverage


@pytest.mark.parametrize("still", [320, 10_000], ids=["a_moment", "half_a_second"])
def test_a_camera_that_stands_still_first(still: int) -> None:
    """The spline once swung between the far views of the still camera: 83 % of error, and no word of it."""
    reconstructor, error, coverage = followed(StandThenMove(path(), still, 64), still + 600)
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    assert error < 3 and coverage > 0.98


def test_a_camera_that_stops_and_goes_on() -> None:
    reconstructor, error, coverage = followed(Halting(path(), 350, 650), 900)
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
    assert any("sideways" in reason for _, _, reason in reconstructor._odometry.changes)


def test_a_short_gap_leaves_the_path_whole() -> None:
    _, error, coverage = followed(path(), 600, lost=(320, 360))
    assert error < 3 and coverage > 0.9
