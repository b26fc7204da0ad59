"""Sharp pictures of a moving scene: spikes carried along the image motion."""

import numpy as np
import pytest

from spiked.recon.frontend.motion_compensation import (
    FIELD_CELL_PX,
    MotionCompensator,
    Motions,
    at,
    fit_field,
    inverted,
    nodes,
    speed,
    warp_frames,
)
from spiked.sensor import BitOrder, Mosaic, Sensor

W, H = 128, 96
STEP = np.array([2.0, 1.0])
"""Motion of the scene in px a frame."""


def stored(pictures: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Bits [n, H, W] as the sensor stores them."""
    order = "little" if sensor.bit_order is BitOrder.LSB else "big"
    rows = pictures[:, ::-1] if sensor.flipped else pictures
    return np.packbits(rows, axis=2, bitorder=order).reshape(len(pictures), -1)


def moving_scene(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Random frames [n, H, W] of a scene of bright squares that moves by STEP, and its radiance when frame n / 2 is
    seen."""
    scene = 0.05 + 0.5 * np.kron(rng.random((40, 50)) < 0.3, np.ones((8, 8)))
    frames = []
    for k in range(count):
        x, y = ([140, 70] - STEP * k).astype(int)
        frames.append(rng.random((H, W)) < scene[y : y + H, x : x + W])
    x, y = ([140, 70] - STEP * (count // 2)).astype(int)
    return np.array(frames), scene[y : y + H, x : x + W]


@pytest.mark.parametrize(("flipped", "order"), [(True, BitOrder.LSB), (False, BitOrder.MSB)])
def test_spikes_are_carried_to_where_the_scene_was_at_one_moment(flipped: bool, order: BitOrder) -> None:
    sensor = Sensor(W, H, 40_000.0, flipped=flipped, bit_order=order)
    frames, radiance = moving_scene(33, np.random.default_rng(0))
    back = -STEP * (np.arange(33) - 16)[:, None]
    grids = np.broadcast_to(back[:, None, None, :], (33, *nodes(W, H).shape)).astype(np.float32)
    seen = warp_frames(stored(frames, sensor), sensor, grids)
    inner = (slice(36, -36), slice(44, -44))
    smeared = frames.mean(0)
    assert np.corrcoef(seen[inner].ravel(), radiance[inner].ravel())[0, 1] > 0.9
    assert np.corrcoef(smeared[inner].ravel(), radiance[inner].ravel())[0, 1] < 0.6
    assert abs(seen[inner].mean() / radiance[inner].mean() - 1) < 0.03


def test_the_motion_is_found_and_taken_out() -> None:
    sensor = Sensor(W, H, 40_000.0, mosaic=Mosaic.BGGR)
    frames, _ = moving_scene(64, np.random.default_rng(1))
    data = stored(frames, sensor)
    assert abs(speed(data[:32], sensor) - np.linalg.norm(STEP)) < 0.2
    compensator = MotionCompensator(sensor, 4)
    compensator.estimate(data, 0, 2.0)
    sharp = compensator.sharp(data, 0, 30.0)
    assert sharp is not None
    scene = moving_scene(60, np.random.default_rng(1))[1][30:-30, 36:-36].ravel()
    assert np.corrcoef(sharp[30:-30, 36:-36].ravel(), scene)[0, 1] > 0.8


def test_nothing_to_follow_gives_no_field_and_no_speed() -> None:
    sensor = Sensor(W, H, 40_000.0)
    assert speed(np.zeros((32, sensor.frame_bytes), np.uint8), sensor) == 0
    assert fit_field(np.zeros((5, 2)), np.zeros((5, 2)), W, H) is None
    compensator = MotionCompensator(sensor, 4)
    data = np.zeros((64, sensor.frame_bytes), np.uint8)
    compensator.estimate(data, 0, 2.0)
    seen = compensator.sharp(data, 0, 30.0)
    assert seen is None or np.isfinite(seen).all()


def test_a_field_goes_through_its_tracks_and_back() -> None:
    rng = np.random.default_rng(2)
    start = rng.uniform([8, 8], [W - 8, H - 8], (200, 2))
    end = start + [5.0, -3.0] + 0.02 * (start - [W / 2, H / 2])
    field = fit_field(start, end, W, H)
    assert field is not None
    assert np.abs(at(field, start) - (end - start)).max() < 0.05
    places = nodes(W, H)
    there = inverted(field[None], places)[0]
    inside = (slice(1, -1), slice(1, -1))
    assert np.abs(at(field, places - there) - there)[inside].max() < 0.02


def test_errors_of_the_motion_cancel_because_both_sides_reach_as_far() -> None:
    still = np.zeros(nodes(W, H).shape)
    motions = Motions(W, H, 2.0, [2.0 + 4 * k for k in range(8)], [still] * 7)
    assert motions.reach(4, 12) == (6.0, 30.0)
    assert motions.reach(0, 12) == (0.0, 8.0)
    motions.fields[2] = None
    low, _ = motions.reach(4, 12)
    assert low == 14.0 and FIELD_CELL_PX % 8 == 0
