"""Tracking that cannot keep up with the camera: views far apart, and the frames between them skipped."""

from dataclasses import replace

import numpy as np
import pytest
from waiting import until

from spiked.evaluate import score_trajectory
from spiked.pose import exp_so3
from spiked.recon import Options, Reconstructor, State
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.seeding import Seeding
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.spline import Waypoints
from spiked.trajectory import Trajectory

FRAMES, EVERY = 6000, 240
MAPPED = 20
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


@pytest.fixture
def live() -> Reconstructor:
    """A live camera, tracked for `MAPPED` views: the first have begun a map, and the others had no time for it."""
    camera = SimulatedCamera(SENSOR, seed=2, motion=MotionKind.ARC, flow_px=0.02, parallax=0.06)
    often = MapOptions(seeding=Seeding(live_px=8.0))
    reconstructor = Reconstructor(SENSOR, Options(steps=20, mapping=often), live=True)
    for first in range(0, MAPPED * EVERY, EVERY):
        reconstructor.track_latest(first, camera.next_frames(EVERY)[: reconstructor.latest_frames])
        if not len(reconstructor.trainer.mapper):
            reconstructor.improve(0.001)
        else:
            reconstructor.sweep_behind()
    return reconstructor


def test_a_live_map_grows_by_sweeps_on_another_thread(live: Reconstructor) -> None:
    trainer = live.trainer
    until(lambda: trainer._sweeping is None or trainer._sweeping.done, "the last sweep has ended")
    live.sweep_behind()
    assert len(trainer.mapper.homes.times) > 1
    assert trainer.mapper.homes.times[-1] > trainer.mapper.homes.times[0]
    steps = trainer.mapper.steps
    live.sweep_behind()
    assert trainer.mapper.steps == steps


def test_a_sweep_is_not_planted_in_a_map_that_was_begun_anew(live: Reconstructor) -> None:
    trainer = live.trainer
    until(lambda: trainer._sweeping is None or trainer._sweeping.done, "the last sweep has ended")
    trainer._swept_px = -np.inf
    live.sweep_behind()  # takes that, and begins another
    sweeping = trainer._sweeping
    assert sweeping is not None
    until(lambda: sweeping.done, "the sweep has ended")
    trainer.restart()
    live.sweep_behind()
    assert len(trainer.mapper) == 0 and not trainer.sweep_due


def test_a_map_is_carried_with_its_path(live: Reconstructor) -> None:
    path, trainer = live.path, live.trainer
    assert isinstance(path, Waypoints)
    trainer.carry(path)
    rotation, centre = (part[0] for part in path.poses([trainer.mapper.homes.times[0]]))
    before = trainer.mapper.render(rotation, centre).copy()
    turn, shift = exp_so3(np.array([0.2, -0.4, 0.1])), np.array([3.0, -1.0, 0.5])
    moved = replace(path, rotations=turn @ path.rotations, centres=path.centres @ turn.T + shift)
    version = trainer.version
    trainer.carry(moved)
    assert trainer.version > version
    assert trainer.mapper.render(turn @ rotation, turn @ centre + shift) == pytest.approx(before, abs=0.02)
    assert np.abs(trainer.mapper.render(rotation, centre) - before).max() > 0.1
    version = trainer.version
    trainer.carry(moved)
    assert trainer.version == version


def test_small_corrections_of_a_path_add_up(live: Reconstructor) -> None:
    path, trainer = live.path, live.trainer
    assert isinstance(path, Waypoints)
    trainer.carry(path)
    means = trainer.mapper.scene.means.copy()
    for number in range(1, 11):  # 0.3 px each
        angle = 0.3 / SENSOR.intrinsics.fx * number if SENSOR.intrinsics else 0.0
        moved = replace(path, rotations=exp_so3(np.array([0, angle, 0])) @ path.rotations)
        trainer.carry(moved)
    assert np.abs(trainer.mapper.scene.means - means).max() > 0.005


def test_tracking_ends_without_a_refinement(live: Reconstructor) -> None:
    splats, told = len(live.scene()), []
    live.end_tracking(told.append, lambda: True)
    assert not live.tracking_ended
    live.end_tracking(told.append)
    assert live.tracking_ended and live.status().stage != "done"
    assert len(live.scene()) == splats
    live.finish()
    assert live.status().stage == "done" and live.trainer.mapper.steps > 0
