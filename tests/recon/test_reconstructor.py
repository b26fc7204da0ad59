"""The whole reconstruction of recordings of the simulated camera, those that work and those that cannot."""

from functools import partial
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spiked.errors import ConfigurationError
from spiked.evaluate import psnr, score_trajectory, similarity_of_trajectories
from spiked.recon import MapOptions, Options, Reconstructor, State
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.schedule import Schedule
from spiked.recon.methods import Initialisation, MethodName, PoseStepName
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

FRAMES = 480


def sensor(mosaic: Mosaic | None = None) -> Sensor:
    return Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 60), mosaic=mosaic)


def record(camera: SimulatedCamera, length: int) -> tuple[np.ndarray, Trajectory]:
    frames = camera.next_frames(length)
    k = np.arange(length)
    return frames, Trajectory((k + 0.5) / camera.sensor.frame_rate_hz, *camera.truth(k))


@pytest.fixture(scope="module")
def shaken() -> tuple[SimulatedCamera, np.ndarray, Trajectory]:
    camera = SimulatedCamera(sensor(), seed=2, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    return camera, *record(camera, FRAMES)


def feed(reconstructor: Reconstructor, frames: np.ndarray, first: int = 0, chunk: int = 40) -> None:
    for i in range(0, len(frames), chunk):
        reconstructor.feed(first + i, frames[i : i + chunk])


def finite(reconstructor: Reconstructor) -> bool:
    scene, path = reconstructor.scene(), reconstructor.trajectory()
    arrays = (*scene.arrays(), path.rotations, path.centres)
    return all(np.isfinite(a).all() for a in arrays)


def test_the_papers_method_goes_on_from_the_tracked_path_by_our_alignment(
    shaken: tuple[SimulatedCamera, np.ndarray, Trajectory],
) -> None:
    """The schedule takes a knot for each view: the prior of the tracked path has others."""
    _, frames, truth = shaken
    theirs = Options(
        steps=60,
        method=MethodName.NOPE_SGS,
        initialisation=Initialisation.TRACKS,
        pose_step=PoseStepName.ALIGNMENT,
    )
    reconstructor = Reconstructor(sensor(), theirs)
    feed(reconstructor, frames)
    reconstructor.finish()
    assert len(reconstructor.scene()) > 1000
    score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=20000.0)
    assert score.errors is not None and score.errors.ate_percent < 6.0


def test_a_shaken_camera_gives_its_path_and_a_scene_that_looks_right(
    shaken: tuple[SimulatedCamera, np.ndarray, Trajectory],
) -> None:
    camera, frames, truth = shaken
    reconstructor = Reconstructor(sensor(), Options(steps=300))
    feed(reconstructor, frames)
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    reconstructor.finish()
    path = reconstructor.trajectory()
    score = score_trajectory(truth=truth, estimate=path, frame_rate_hz=20000.0)
    assert score.coverage > 0.98
    assert score.errors is not None and score.errors.ate_percent < 3.0 and score.errors.rpe_r_deg < 0.1
    carried = similarity_of_trajectories(truth=truth, estimate=path, frame_rate_hz=20000.0)
    k = FRAMES // 2
    rotation, centre = carried.poses(truth.rotations[k : k + 1], truth.centres[k : k + 1])
    seen = camera.view(truth.rotations[k], truth.centres[k])
    rendered = reconstructor.view(rotation[0], centre[0])[..., 0]
    assert psnr(rendered / reconstructor.white, seen / reconstructor.white) > 24


@pytest.mark.parametrize(("steps", "budget_s"), [(200, None), (10**6, 6.0)])
def test_a_refinement_ends_settled(
    shaken: tuple[SimulatedCamera, np.ndarray, Trajectory],
    monkeypatch: pytest.MonkeyPatch,
    steps: int,
    budget_s: float | None,
) -> None:
    """The last views alone would add their noise. With less time than its steps take it comes to the same end."""
    clock = SimpleNamespace(perf_counter=partial(next, count(0.0, 0.02)))  # each reading is 20 ms after the last
    monkeypatch.setattr("spiked.recon.run_progress.time", clock)
    monkeypatch.setattr("spiked.recon.reconstructor.time", clock)
    moved: list[float] = []
    step = Mapper.step

    def watched(mapper: Mapper, *arguments: Any) -> Any:
        before = mapper.scene.means.copy()
        done = step(mapper, *arguments)
        moved.append(float(np.linalg.norm(mapper.scene.means - before, axis=1).mean()))
        return done

    monkeypatch.setattr(Mapper, "step", watched)
    reconstructor = Reconstructor(sensor(), Options(steps=steps))
    feed(reconstructor, shaken[1])
    reconstructor.finish(budget_s=budget_s)
    assert len(moved) == steps or budget_s is not None
    before = moved[int(0.75 * len(moved)) : int(0.85 * len(moved))]
    assert np.mean(moved[-3:]) < 0.3 * np.mean(before)


def test_the_scene_grows_while_frames_arrive(shaken: tuple[SimulatedCamera, np.ndarray, Trajectory]) -> None:
    _, frames, _ = shaken
    reconstructor = Reconstructor(sensor())
    versions, splats = [], []
    for i in range(0, FRAMES, 40):
        reconstructor.feed(i, frames[i : i + 40])
        reconstructor.improve(0.02)
        versions.append(reconstructor.status().version)
        splats.append(reconstructor.status().splats)
    assert versions == sorted(versions) and splats[-1] > 500
    assert len(reconstructor.trajectory()) > 0.9 * FRAMES
    report = reconstructor.report()
    assert report["frames"] == FRAMES and report["states"]


def test_same_seed_same_bits(shaken: tuple[SimulatedCamera, np.ndarray, Trajectory]) -> None:
    _, frames, _ = shaken
    scenes = []
    for threads, chunk in ((1, 40), (2, 64)):
        reconstructor = Reconstructor(sensor(), Options(steps=20, threads=threads))
        feed(reconstructor, frames, chunk=chunk)
        reconstructor.finish()
        scenes.append(reconstructor.scene())
    for a, b in zip(scenes[0].arrays(), scenes[1].arrays(), strict=True):
        np.testing.assert_array_equal(a, b)


def scene_psnr_db(reconstructor: Reconstructor) -> float:
    return reconstructor.scene_psnr_db(
        reconstructor.scene(), reconstructor.trajectory(), reconstructor.camera.intrinsics
    )


def test_a_refinement_cancelled_at_once_leaves_the_live_map(
    shaken: tuple[SimulatedCamera, np.ndarray, Trajectory],
) -> None:
    """A map that was a little off the final path was rebuilt after the end had been asked for, and not refined."""
    _, frames, _ = shaken
    always_stale = MapOptions(schedule=Schedule(stale_px=-1.0))
    reconstructor = Reconstructor(sensor(), Options(mapping=always_stale))
    for first in range(0, FRAMES, 40):
        reconstructor.feed(first, frames[first : first + 40])
        reconstructor.improve(0.2)
    reconstructor.improve(3.0)
    before, live_map = scene_psnr_db(reconstructor), reconstructor.scene()
    stages: list[str] = []
    reconstructor.finish(lambda status: stages.append(status.stage), cancelled=lambda: True)
    after = reconstructor.scene()
    assert stages[0] == "refining"
    for a, b in zip(live_map.arrays(), after.arrays(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert scene_psnr_db(reconstructor) > before - 0.5
    assert len(reconstructor.trajectory()) > 0.95 * FRAMES


def test_scene_psnr_falls_with_missing_splats_and_missing_poses_but_not_with_brightness(
    shaken: tuple[SimulatedCamera, np.ndarray, Trajectory],
) -> None:
    reconstructor = Reconstructor(sensor(), Options(steps=150))
    feed(reconstructor, shaken[1])
    reconstructor.finish()
    scene, path, optics = reconstructor.scene(), reconstructor.trajectory(), reconstructor.camera.intrinsics
    good = scene_psnr_db(reconstructor)
    half = scene.select(np.arange(0, len(scene), 2))
    part = Trajectory(path.times_s[:-240], path.rotations[:-240], path.centres[:-240])
    assert good > 20
    assert reconstructor.scene_psnr_db(half, path, optics) < good - 3
    assert reconstructor.scene_psnr_db(scene, part, optics) < good - 3
    brighter = scene.select(np.arange(len(scene)))
    brighter.colours *= 2
    assert abs(reconstructor.scene_psnr_db(brighter, path, optics) - good) < 0.01


def test_given_poses_are_kept(shaken: tuple[SimulatedCamera, np.ndarray, Trajectory]) -> None:
    _, frames, truth = shaken
    reconstructor = Reconstructor(sensor(), Options(steps=100, poses=truth))
    feed(reconstructor, frames)
    reconstructor.finish()
    path = reconstructor.trajectory()
    found = path.nearest(truth.times_s, 1e-6)
    assert (found >= 0).mean() > 0.95
    np.testing.assert_allclose(path.centres[found[found >= 0]], truth.centres[found >= 0], atol=1e-3)
    assert len(reconstructor.scene()) > 500


def test_views_with_given_poses_stay_in_the_unit_of_these(
    shaken: tuple[SimulatedCamera, np.ndarray, Trajectory],
) -> None:
    """The map has another unit from the end on; the last views are tracked just before it."""
    _, frames, truth = shaken
    far = Trajectory(truth.times_s, truth.rotations, 10 * truth.centres)
    reconstructor = Reconstructor(sensor(), Options(steps=0, poses=far))
    feed(reconstructor, frames)
    reconstructor.finish()
    for view in reconstructor.tracked():
        (row,) = far.nearest(np.array([view.time_s]), 1e-4)
        assert view.centre is not None
        np.testing.assert_allclose(view.centre, far.centres[row], atol=0.02)


def test_a_recording_of_forty_frames_says_that_it_is_too_short() -> None:
    reconstructor = Reconstructor(sensor())
    feed(reconstructor, SimulatedCamera(sensor(), seed=1).next_frames(40))
    reconstructor.finish()
    assert reconstructor.status().state is State.BOOT and "too short" in reconstructor.status().reason
    assert len(reconstructor.trajectory()) == 0 and len(reconstructor.scene()) == 0


@pytest.mark.parametrize("value", [0x00, 0xFF])
def test_all_dark_and_all_bright_stay_in_boot_with_a_reason(value: int) -> None:
    reconstructor = Reconstructor(sensor())
    feed(reconstructor, np.full((320, sensor().frame_bytes), value, np.uint8))
    reconstructor.finish()
    status = reconstructor.status()
    assert status.state is State.BOOT and "texture or light" in status.reason
    assert finite(reconstructor)


def test_pure_rotation_makes_no_depth() -> None:
    camera = SimulatedCamera(sensor(), seed=3, motion=MotionKind.ROTATION)
    reconstructor = Reconstructor(sensor())
    feed(reconstructor, camera.next_frames(400))
    reconstructor.finish()
    assert reconstructor.status().state is State.BOOT and "sideways" in reconstructor.status().reason


def test_a_mosaic_camera_gives_a_coloured_scene() -> None:
    colour = sensor(Mosaic.BGGR)
    camera = SimulatedCamera(colour, seed=2, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    frames, truth = record(camera, FRAMES)
    reconstructor = Reconstructor(colour, Options(steps=150))
    feed(reconstructor, frames)
    reconstructor.finish()
    score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=20000.0)
    assert score.errors is not None and score.errors.ate_percent < 5.0
    assert reconstructor.scene().colours.shape[1] == 3
    assert np.std(reconstructor.scene().colours, axis=1).mean() > 0.003


def test_given_poses_need_a_focal_length(shaken: tuple[SimulatedCamera, np.ndarray, Trajectory]) -> None:
    with pytest.raises(ConfigurationError, match="--fov"):
        Reconstructor(Sensor(240, 160, 20000.0), Options(poses=shaken[2]))
