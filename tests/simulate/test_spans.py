"""Long recordings interpolate between few exact pictures: as far apart as stated and with the error that is stated."""

import json
import tracemalloc
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.recording import open_recording
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, SensorNoise, SimulatedCamera
from spiked.simulate.camera import LONG_FRAMES, LONG_STEP_PX, default_step_px
from spiked.simulate.motion import Motion, Recorded
from spiked.simulate.record import simulate
from spiked.simulate.spans import PathRadiance, interpolation_error, spaced_spans
from spiked.simulate.splats import SplatScene
from spiked.trajectory import Trajectory

SENSOR = Sensor(128, 80, 20000.0)
SMALL = Sensor(64, 40, 20000.0)


def radiance(sensor: Sensor = SENSOR, motion: Motion | None = None, flow_px: float = 0.02) -> PathRadiance:
    camera = SimulatedCamera(sensor, 1, flow_px=flow_px)
    return PathRadiance(camera.scene, motion or camera.motion, sensor, camera.intrinsics, camera.gain)


def way_ahead(metres: float, frames: float) -> Recorded:
    """From the start of the room's path straight ahead; at rest before and after it."""
    rotations, centres = SimulatedCamera(SENSOR, 1).motion.poses([0.0])
    ends = np.concatenate([centres, centres + metres * rotations[:, :, 2]])
    return Recorded(np.array([0.0, frames]), np.repeat(rotations, 2, 0), ends)


def along_a_wall() -> PathRadiance:
    """Past a wall of patches of splats, two units away, at an even 0.03 px a frame: nothing is hidden or uncovered."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[-2:2:80j, -3:3:120j]
    n = x.size
    colours = np.repeat(rng.uniform(0.2, 1, (n // 4, 1)), 4, 0).astype(np.float32)
    means = np.stack([x.ravel(), y.ravel(), np.full(n, 2.0)], 1).astype(np.float32)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    log_scales = np.tile(np.log(np.float32([0.03, 0.03, 0.01])), (n, 1))
    scene = SplatScene(Scene(means, quats, log_scales, np.full(n, 4, np.float32), colours))
    k = Intrinsics.from_fov(SENSOR.width, SENSOR.height, 60)
    way = np.array([[0.0, 0, 0], [0.03 * 2 / k.fx * 2000, 0, 0]])
    return PathRadiance(scene, Recorded(np.array([0.0, 2000]), np.tile(np.eye(3), (2, 1, 1)), way), SENSOR, k, 0.35)


def bits(sensor: Sensor, stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.unpackbits(stored.reshape(len(stored), sensor.height, -1), axis=2, bitorder="little")[:, ::-1]


def test_only_long_recordings_are_interpolated_by_default() -> None:
    assert default_step_px(LONG_FRAMES) is None
    assert default_step_px(LONG_FRAMES + 1) == LONG_STEP_PX


def test_exact_pictures_are_as_far_apart_as_stated() -> None:
    path = radiance()
    frame = 0
    for span in islice(spaced_spans(path, 0.3), 12):
        end = frame + len(span.weights)
        assert np.array_equal(span.first, path.at(frame))
        assert np.array_equal(span.last, path.at(end))
        near = float(np.percentile(path.at_with_depth(frame)[1], 5))
        steps = path.steps_px(np.arange(frame, end + 2.0), near)
        assert steps[:-1].sum() < 0.31
        assert steps.sum() > 0.29
        frame = end
    assert frame > 12 * 8


def test_the_depth_that_motion_is_judged_at_follows_the_camera() -> None:
    """A camera that nears a wall gets more pictures for the same way."""
    path = radiance(motion=way_ahead(1.0, 8000))
    lengths = [len(span.weights) for span in islice(spaced_spans(path, 3.0), 20)]
    assert lengths[-1] < 0.9 * lengths[0]


def test_a_camera_at_rest_gives_bounded_spans() -> None:
    path = radiance(motion=way_ahead(0.01, 1))
    spans = list(islice(spaced_spans(path, 0.3, start=2), 3))
    assert [len(span.weights) for span in spans] == [512] * 3
    assert all(np.array_equal(span.last, path.at(1)) for span in spans)


def test_the_stated_error_is_that_of_the_frames_in_between() -> None:
    path = along_a_wall()
    stated = interpolation_error(path, 0.3, 1000)
    middles: list[float] = []
    quarters: list[float] = []
    frame = 0
    for span in islice(spaced_spans(path, 0.3), 30):
        for squares, k in ((middles, len(span.weights) // 2), (quarters, len(span.weights) // 4)):
            seen = span.first + span.weights[k] * (span.last - span.first)
            squares.append(np.square(seen - path.at(frame + k + 0.5)).mean())
        frame += len(span.weights)
    assert np.mean(quarters) < np.mean(middles)
    rms = 100 * np.sqrt(np.mean(middles)) / path.gain
    assert stated.rms_percent == pytest.approx(rms, rel=0.3)
    assert stated.samples == 32
    assert 0 < stated.rms_percent <= stated.worst_rms_percent < stated.max_percent < 5


def test_half_the_step_makes_a_quarter_of_the_error() -> None:
    coarse, fine = (interpolation_error(along_a_wall(), step, 1000) for step in (0.6, 0.3))
    assert fine.rms_percent == pytest.approx(coarse.rms_percent / 4, rel=0.25)
    assert coarse.rms_percent < 0.5


@pytest.mark.parametrize(("kind", "flow_px"), [(MotionKind.HAND_SHAKE, 0.2), (MotionKind.KINKED, 1.2)])
def test_an_interpolated_camera_records_the_mean_of_its_views(kind: MotionKind, flow_px: float) -> None:
    camera = SimulatedCamera(SENSOR, 2, kind, noise=SensorNoise.none(), gain=0.9, flow_px=flow_px, step_px=0.3)
    rate = bits(SENSOR, camera.next_frames(64)).mean(0)
    rotations, centres = camera.motion.poses(np.arange(0, 64, 0.25) + 0.125)
    mean = np.mean([camera.view(r, c) for r, c in zip(rotations, centres, strict=True)], 0)
    # A spike more or less in 64 frames, from the unknown phase.
    assert np.abs(rate - np.minimum(mean, 1)).max() < 1.2 / 64


def test_each_site_of_a_mosaic_sees_its_channel() -> None:
    sensor = Sensor(64, 40, 20000.0, mosaic=Mosaic.BGGR)
    path = radiance(sensor)
    span = next(spaced_spans(path, 0.3))
    rotations, centres = path.motion.poses([0.0])
    colours = path.gain * path.view(rotations[0], centres[0]).intensity
    channels = Mosaic.BGGR.channels(40, 64)[..., None].astype(int)
    assert np.allclose(span.first, np.take_along_axis(colours, channels, 2)[..., 0])


def test_calls_of_any_size_and_threads_give_the_same_frames() -> None:
    whole = SimulatedCamera(SENSOR, 3, flow_px=0.02, step_px=0.3).next_frames(150)
    camera = SimulatedCamera(SENSOR, 3, flow_px=0.02, step_px=0.3, threads=2)
    assert np.array_equal(whole, np.concatenate([camera.next_frames(n) for n in (1, 7, 0, 113, 29)]))
    assert not np.array_equal(whole, SimulatedCamera(SENSOR, 3, flow_px=0.02).next_frames(150))


@pytest.mark.parametrize("step", [0.0, -1.0, float("nan")])
def test_a_step_must_be_positive(step: float) -> None:
    with pytest.raises(ConfigurationError, match="must be positive"):
        SimulatedCamera(SENSOR, step_px=step)


def test_the_sidecar_states_the_error(tmp_path: Path) -> None:
    camera = SimulatedCamera(SMALL, 1, step_px=0.5)
    path = simulate(camera, tmp_path / "walk", "walk", 100, views=0)
    stated = json.loads(path.with_suffix(".json").read_text())["simulation"]["interpolation"]
    assert stated["step_px"] == 0.5
    assert stated == vars(interpolation_error(radiance(SMALL, camera.motion), 0.5, 100))
    exact = simulate(SimulatedCamera(SMALL, 1), tmp_path / "exact", "walk", 100, views=0)
    assert "interpolation" not in json.loads(exact.with_suffix(".json").read_text())["simulation"]


def test_a_short_recording_is_the_beginning_of_a_longer_one(tmp_path: Path) -> None:
    paths = [
        simulate(SimulatedCamera(SMALL, 1, step_px=0.3), tmp_path / str(frames), "walk", frames, views=0)
        for frames in (100, 333)
    ]
    short, long = (open_recording(path) for path in paths)
    assert np.array_equal(short.read(0, 100), long.read(0, 100))


def test_memory_does_not_grow_with_length(tmp_path: Path) -> None:
    peaks = []
    for frames in (17_000, 50_000):
        camera = SimulatedCamera(SMALL, 1, way_ahead(0.01, frames), step_px=0.3)
        tracemalloc.start()
        path = simulate(camera, tmp_path / str(frames), "walk", frames, views=2)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        truth = Trajectory.read_tum(path.parent / "groundtruth.tum")
        rotations, centres = camera.truth(np.arange(frames))
        assert np.allclose(truth.times_s * 20000, np.arange(frames) + 0.5)
        assert np.allclose(truth.centres, centres, atol=1e-8)
        assert np.allclose(truth.rotations, rotations, atol=1e-7)
    assert peaks[1] < 1.1 * peaks[0]


def test_the_coverage_of_a_view_is_the_share_of_its_points_in_some_picture(tmp_path: Path) -> None:
    """A camera that turns away: the path's pictures, every 64th, against each view, one by one."""
    start = SimulatedCamera(SENSOR, 1).motion.poses([0.0])
    turn = np.array([cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0] for angle in np.radians([0, 60, 170])])
    motion = Recorded(np.array([0.0, 400, 800]), start[0] @ turn, np.repeat(start[1], 3, 0))
    camera = SimulatedCamera(SENSOR, 1, motion, step_px=2.0)
    path = simulate(camera, tmp_path / "turn", "turn", 900, views=6)
    rotations, centres = camera.truth(np.arange(0, 900, 64))
    k = camera.intrinsics
    for view in json.loads((path.parent / "views.json").read_text())["views"]:
        pose = np.array(view["c2w"])
        depth = camera.depth(pose[:3, :3], pose[:3, 3])[::5, ::5]
        y, x = np.mgrid[0:80:5, 0:128:5] + 0.5
        points = pose[:3, 3] + (k.unproject(np.stack([x, y], -1)) * depth[..., None]) @ pose[:3, :3].T
        seen = np.zeros(depth.shape, bool)
        for rotation, centre in zip(rotations, centres, strict=True):
            local = (points - centre) @ rotation
            u, v = np.moveaxis(k.project(local), -1, 0)
            seen |= (local[..., 2] > 0) & (u >= 0) & (u < 128) & (v >= 0) & (v < 80)
        assert view["coverage"] == pytest.approx(seen.mean())
    assert seen.mean() > 0.5
