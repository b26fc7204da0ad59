"""What the simulated camera records is what it says it saw, from where it says it was."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.evaluate import psnr
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, Room, SensorNoise, SimulatedCamera

SENSOR = Sensor(128, 80, 20000.0)


def upright(sensor: Sensor, stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
    bits = np.unpackbits(stored.reshape(len(stored), sensor.height, -1), axis=2, bitorder="little")
    return bits[:, ::-1] if sensor.flipped else bits


@pytest.mark.parametrize("flipped", [True, False])
def test_a_still_camera_records_its_view(flipped: bool) -> None:
    sensor = Sensor(128, 80, 20000.0, flipped=flipped)
    camera = SimulatedCamera(sensor, 1, MotionKind.STAND_THEN_MOVE, noise=SensorNoise.none())
    rate = upright(sensor, camera.next_frames(300)).mean(0)
    rotations, centres = camera.truth([0])
    view = camera.view(rotations[0], centres[0])
    assert psnr(rate / 0.35, view / 0.35) > 40
    assert psnr(rate[::-1] / 0.35, view / 0.35) < 20


@pytest.mark.parametrize("mosaic", Mosaic)
def test_each_site_of_a_mosaic_sees_its_channel(mosaic: Mosaic) -> None:
    sensor = Sensor(128, 80, 20000.0, mosaic=mosaic)
    camera = SimulatedCamera(sensor, 1, MotionKind.STAND_THEN_MOVE, noise=SensorNoise.none())
    rate = upright(sensor, camera.next_frames(300)).mean(0)
    rotations, centres = camera.truth([0])
    view = camera.view(rotations[0], centres[0])
    assert view.shape == (80, 128, 3)
    sites = np.take_along_axis(view, mosaic.channels(80, 128)[..., None].astype(int), 2)[..., 0]
    assert psnr(rate / 0.35, sites / 0.35) > 40
    swapped = np.take_along_axis(view[..., ::-1], mosaic.channels(80, 128)[..., None].astype(int), 2)[..., 0]
    assert psnr(rate / 0.35, swapped / 0.35) < 30


@pytest.mark.parametrize(("kind", "flow_px"), [(MotionKind.HAND_SHAKE, 0.2), (MotionKind.KINKED, 1.2)])
def test_a_moving_camera_records_the_mean_of_its_views(kind: MotionKind, flow_px: float) -> None:
    camera = SimulatedCamera(SENSOR, 2, kind, noise=SensorNoise.none(), gain=0.9, flow_px=flow_px)
    rate = upright(SENSOR, camera.next_frames(64)).mean(0)
    rotations, centres = camera.motion.poses(np.arange(0, 64, 0.25) + 0.125)
    mean = np.mean([camera.view(r, c) for r, c in zip(rotations, centres, strict=True)], 0)
    still = camera.view(rotations[0], centres[0])
    assert psnr(rate / 0.9, np.minimum(mean, 1) / 0.9) > 35
    assert psnr(rate / 0.9, np.minimum(still, 1) / 0.9) < psnr(rate / 0.9, np.minimum(mean, 1) / 0.9) - 6


def test_calls_of_any_size_and_threads_give_the_same_frames() -> None:
    whole = SimulatedCamera(SENSOR, 3).next_frames(50)
    camera = SimulatedCamera(SENSOR, 3, threads=2)
    assert np.array_equal(whole, np.concatenate([camera.next_frames(n) for n in (1, 7, 0, 13, 29)]))
    assert not np.array_equal(whole, SimulatedCamera(SENSOR, 4).next_frames(50))


def test_poses_and_depth_explain_how_the_picture_moves() -> None:
    """The later view, looked up where the first one's points fall in it, is the first view."""
    sensor = Sensor(256, 160, 20000.0, intrinsics=Intrinsics.from_fov(256, 160, 60))
    camera = SimulatedCamera(sensor, 5, parallax=0.15)
    (r0, r1), (c0, c1) = camera.truth([0, 1280])
    first, later, depth = camera.view(r0, c0), camera.view(r1, c1), camera.depth(r0, c0)
    k = camera.intrinsics
    y, x = np.mgrid[0:160, 0:256] + 0.5
    points = c0 + (np.stack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones_like(x)], -1) * depth[..., None]) @ r0.T
    local = (points - c1) @ r1
    u = (k.fx * local[..., 0] / local[..., 2] + k.cx - 0.5).astype(np.float32)
    v = (k.fy * local[..., 1] / local[..., 2] + k.cy - 0.5).astype(np.float32)
    warped = cv2.remap(later, u, v, cv2.INTER_LINEAR)
    hidden = np.abs(cv2.remap(camera.depth(r1, c1), u, v, cv2.INTER_NEAREST) / local[..., 2] - 1) > 0.02
    seen = (u > 1) & (u < 254) & (v > 1) & (v < 158) & ~hidden
    assert seen.mean() > 0.5
    assert np.hypot(u - x, v - y)[seen].mean() > 5
    assert psnr(warped[seen] / 0.35, first[seen] / 0.35) > 30
    assert psnr(later[seen] / 0.35, first[seen] / 0.35) < 22


def test_the_room_is_textured_everywhere() -> None:
    """No patch of a sixth of the picture is flat, whichever way the camera turns."""
    room = Room()
    k = Intrinsics.from_fov(192, 120, 60)
    stage = room.stage(k)
    for degrees in range(0, 360, 60):
        turn = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))[0]
        view = room.render(k, 192, 120, stage.rotation @ turn, stage.centre)
        assert np.isfinite(view.depth).all() and view.depth.min() > 0.1
        patches = view.intensity[..., 0].reshape(6, 20, 6, 32)
        assert (patches.std((1, 3)) / patches.mean((1, 3))).min() > 0.04


def test_pictures_are_free_of_aliasing() -> None:
    """Averaged down, a picture four times as large is the picture, but for its slightly softer filter."""
    room = Room()
    k, fine = Intrinsics.from_fov(400, 240, 60), Intrinsics.from_fov(1600, 960, 60)
    stage = room.stage(k)
    small = room.render(k, 400, 240, stage.rotation, stage.centre).intensity[..., 0]
    large = room.render(fine, 1600, 960, stage.rotation, stage.centre).intensity[..., 0]
    assert psnr(large.reshape(240, 4, 400, 4).mean((1, 3)), small) > 33


def test_a_kind_of_path_needs_the_room() -> None:
    with pytest.raises(ConfigurationError, match="path in its coordinates"):
        SimulatedCamera(SENSOR, scene=Room())
