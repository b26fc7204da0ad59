"""Tracking that cannot keep up with the camera: views far apart, and the frames between them skipped."""

import numpy as np
import pytest

from spiked.evaluate import score_trajectory
from spiked.recon import Options, Reconstructor, State
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

FRAMES, EVERY = 6000, 240
SENSOR = Sensor(240, 160, 20_000.0, intrinsics=Intrinsics.from_fov(240, 160, 60))


@pytest.fixture(scope="module")
def skipped() -> tuple[Reconstructor, Trajectory]:
    """5 px from view to view, in a quarter of a second; the truth."""
    camera = SimulatedCamera(SENSOR, seed=2, motion=MotionKind.ARC, flow_px=0.02, parallax=0.06)
    reconstructor = Reconstructor(SENSOR, Options(steps=60))
    for first in range(0, FRAMES, EVERY):
        frames = camera.next_frames(EVERY)
        if first == 15 * EVERY:
            reconstructor.gap(first, EVERY)
        else:
            reconstructor.track_latest(first, frames[: reconstructor.latest_frames])
        reconstructor.improve(0.01)
    k = np.arange(FRAMES)
    return reconstructor, Trajectory((k + 0.5) / SENSOR.frame_rate_hz, *camera.truth(k))


def test_the_path_is_known_between_tracked_views_but_not_over_a_gap(skipped: tuple[Reconstructor, Trajectory]) -> None:
    reconstructor, truth = skipped
    assert reconstructor.status().state in (State.TRACK, State.DEGRADED), reconstructor.status().reason
    path = reconstructor.trajectory()
    frames = np.round(path.times_s * SENSOR.frame_rate_hz - 0.5).astype(int)
    lost = (frames > 15 * EVERY - 60) & (frames < 16 * EVERY - 80)
    assert not lost.any()
    assert len(frames) > 0.85 * FRAMES
    errors = score_trajectory(truth=truth, estimate=path, frame_rate_hz=SENSOR.frame_rate_hz).errors
    assert errors is not None and errors.ate_percent < 3


def test_a_path_of_skipped_frames_is_mapped_and_refined(skipped: tuple[Reconstructor, Trajectory]) -> None:
    reconstructor, _ = skipped
    before = len(reconstructor.trajectory())
    reconstructor.finish()
    assert reconstructor.status().stage == "done"
    assert len(reconstructor.scene()) > 500
    assert len(reconstructor.trajectory()) == before
    assert reconstructor.report()["knot_spacing_frames"] is None
