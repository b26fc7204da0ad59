"""The loss of the charge between spikes: its derivative, its minimum, and what it makes of moving scenes."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from spiked.errors import ConfigurationError
from spiked.render.charge import WARP_CELL_PX, ChargeLoss
from spiked.sensor import BitOrder, Mosaic, Sensor

WIDTH, HEIGHT, FRAMES = 88, 40, 24
STEP = np.array([1.3, 0.4])
"""Motion of the scene, px a frame."""


def nodes() -> tuple[int, int]:
    return -(-HEIGHT // WARP_CELL_PX) + 1, -(-WIDTH // WARP_CELL_PX) + 1


def back(step: np.ndarray) -> np.ndarray:
    """Displacements from each frame to where the scene is in the middle one."""
    moved = -step * (np.arange(FRAMES) + 0.5 - FRAMES / 2)[:, None]
    return np.broadcast_to(moved[:, None, None], (FRAMES, *nodes(), 2)).astype(np.float32)


def scene(x: np.ndarray, y: np.ndarray, colours: int) -> np.ndarray:
    """Radiance [..., colours] at places, in spikes a frame."""
    waves = 0.2 + 0.08 * np.sin(0.7 * x + 0.3 * y) + 0.08 * np.cos(0.9 * y - 0.2 * x)
    tint = np.array([1.0]) if colours == 1 else np.array([0.6, 1.0, 0.8])
    return waves[..., None] * tint


def image(colours: int, pixel: int = 1) -> np.ndarray:
    """The scene as it is in the middle, [h, w] or [h, w, 3]."""
    y, x = np.mgrid[0 : HEIGHT // pixel, 0 : WIDTH // pixel] * pixel + 0.5 * pixel
    values = scene(x, y, colours).astype(np.float32)
    return values[..., 0] if colours == 1 else values


def recorded(sensor: Sensor, gain: np.ndarray, dark: float = 0.0, seed: int = 0) -> np.ndarray:
    """Stored frames of a sensor that integrates while the scene moves by STEP."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    charge = np.random.default_rng(seed).random((HEIGHT, WIDTH))
    colours = 1 if sensor.mosaic is None else 3
    channels = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    if sensor.mosaic is not None:
        channels = sensor.mosaic.channels(HEIGHT, WIDTH)[..., None]
    bits = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    for f in range(FRAMES):
        light = np.zeros((HEIGHT, WIDTH))
        for part in (0.125, 0.375, 0.625, 0.875):
            dx, dy = -STEP * (f + part - FRAMES / 2)
            seen = scene(x + dx, y + dy, colours)
            light += 0.25 * np.take_along_axis(seen, channels, 2)[..., 0]
        charge += gain * light + dark
        bits[f] = charge >= 1
        charge -= bits[f]
    rows = bits[:, ::-1] if sensor.flipped else bits
    order = "little" if sensor.bit_order is BitOrder.LSB else "big"
    return np.packbits(rows, axis=2, bitorder=order).reshape(FRAMES, -1)


SENSORS = {
    "grey": Sensor(WIDTH, HEIGHT, 40_000.0),
    "upright, MSB": Sensor(WIDTH, HEIGHT, 40_000.0, flipped=False, bit_order=BitOrder.MSB),
    "mosaic": Sensor(WIDTH, HEIGHT, 40_000.0, mosaic=Mosaic.GRBG),
}


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("pixel", [1, 2])
def test_the_slope_is_the_derivative_of_the_loss(name: str, pixel: int) -> None:
    sensor, rng = SENSORS[name], np.random.default_rng(1)
    gain = rng.uniform(0.9, 1.1, (HEIGHT, WIDTH)).astype(np.float32)
    gain[rng.random(gain.shape) < 0.05] = 0
    dark = rng.uniform(0, 0.01, gain.shape).astype(np.float32)
    frames = recorded(sensor, gain)
    there = image(1 if sensor.mosaic is None else 3, pixel)
    there = there + rng.normal(0, 0.02, there.shape).astype(np.float32)
    turning = back(STEP) + rng.normal(0, 0.4, (FRAMES, *nodes(), 2)).astype(np.float32)
    loss = ChargeLoss(sensor, 1)

    def at(picture: np.ndarray) -> tuple[float, np.ndarray]:
        found = loss(picture.astype(np.float32), frames, turning, gain, dark, pixel=pixel, floor=0.01)
        return found.loss, found.slope

    slope = at(there)[1]
    assert slope.shape == there.shape
    for _ in range(4):
        way = rng.normal(size=there.shape)
        step = 0.01  # the loss is a square: any step gives the derivative exactly
        measured = (at(there + step * way)[0] - at(there - step * way)[0]) / (2 * step)
        assert measured == pytest.approx(float((slope * way).sum()), rel=2e-3, abs=1e-6)


@pytest.mark.parametrize("name", SENSORS)
def test_the_true_image_is_at_the_minimum_and_explains_what_was_counted(name: str) -> None:
    sensor = SENSORS[name]
    gain = np.ones((HEIGHT, WIDTH), np.float32)
    frames, true = recorded(sensor, gain, dark=0.002), image(1 if sensor.mosaic is None else 3)
    loss = ChargeLoss(sensor, 1)
    dark = np.full_like(gain, 0.002)
    found = loss(true, frames, back(STEP), gain, dark, floor=0.01, jitter=0.005)
    # Spikes come where it is bright, and there a frame's charge is larger than on average.
    assert 0.7 < found.chi2 < 1.7
    assert found.brightness == pytest.approx(1, abs=0.01)
    for other, moved in ((1.05 * true, STEP), (true, STEP + np.array([0.1, 0])), (np.roll(true, 1, 1), STEP)):
        worse = loss(other.astype(np.float32), frames, back(np.asarray(moved)), gain, dark, floor=0.01, jitter=0.005)
        assert worse.loss > 1.1 * found.loss
    assert loss(1.1 * true, frames, back(STEP), gain, dark, floor=0.01).brightness == pytest.approx(1 / 1.1, abs=0.02)


@pytest.mark.parametrize("name", SENSORS)
def test_spikes_are_where_they_fell_to_a_twentieth_of_a_frame(name: str) -> None:
    sensor, gain = SENSORS[name], np.ones((HEIGHT, WIDTH), np.float32)
    true, loss = image(1 if sensor.mosaic is None else 3), ChargeLoss(sensor, 1)
    early, now, late = (
        np.mean([loss(true, recorded(sensor, gain, seed=seed), moved, gain, floor=0.01).loss for seed in range(4)])
        for moved in (back(STEP) + np.float32(frames) * STEP.astype(np.float32) for frames in (-0.5, 0, 0.5))
    )
    assert now < 0.95 * min(early, late)
    assert 0.25 * (early - late) / (early - 2 * now + late) == pytest.approx(0, abs=0.05)


def test_descending_on_it_finds_a_scene_that_windows_smear() -> None:
    sensor, gain = SENSORS["grey"], np.ones((HEIGHT, WIDTH), np.float32)
    frames, true = recorded(sensor, gain), image(1)
    loss = ChargeLoss(sensor, 1)
    guess = np.full((HEIGHT, WIDTH), 0.2, np.float32)
    for _ in range(300):
        guess -= 0.4 * guess.size * loss(guess, frames, back(STEP), gain, floor=0.01).slope
    counts = np.unpackbits(frames, axis=1, bitorder="little").reshape(FRAMES, HEIGHT, WIDTH)[:, ::-1].mean(0)
    errors = [cv2.GaussianBlur(picture - true, (0, 0), 1.0)[8:-8, 20:-20].std() for picture in (guess, counts)]
    contrast = float(true[8:-8, 20:-20].std())
    assert errors[0] < 0.35 * contrast
    assert errors[0] < 0.6 * errors[1]


def test_pixels_that_always_fire_only_say_that_it_is_bright() -> None:
    sensor, gain = SENSORS["grey"], np.ones((HEIGHT, WIDTH), np.float32)
    frames = np.full((FRAMES, sensor.frame_bytes), 255, np.uint8)
    loss = ChargeLoss(sensor, 1)
    bright = loss(np.full((HEIGHT, WIDTH), 1.7, np.float32), frames, back(0 * STEP), gain, floor=0.01)
    assert not bright.slope.any()
    dim = loss(np.full((HEIGHT, WIDTH), 0.7, np.float32), frames, back(0 * STEP), gain, floor=0.01)
    assert (dim.slope[2:-2, 2:-2] < 0).all()


def test_the_number_of_threads_changes_no_bit() -> None:
    sensor, gain = SENSORS["mosaic"], np.ones((HEIGHT, WIDTH), np.float32)
    frames = recorded(sensor, gain)
    one, three = (ChargeLoss(sensor, t)(image(3), frames, back(STEP), gain, floor=0.01) for t in (1, 3))
    assert one.loss == three.loss and one.chi2 == three.chi2
    np.testing.assert_array_equal(one.slope, three.slope)


def test_parts_of_the_rows_make_the_whole() -> None:
    sensor, gain = SENSORS["mosaic"], np.ones((HEIGHT, WIDTH), np.float32)
    frames, loss = recorded(sensor, gain), ChargeLoss(sensor, 1)
    gain[-8:] = 0  # the image ends before the last row: so every part has as many pixels that count
    whole = loss(image(3), frames, back(0 * STEP), gain, floor=0.01)
    parts = [loss(image(3), frames, back(0 * STEP), gain, every=4, phase=p, floor=0.01) for p in range(4)]
    assert np.mean([part.loss for part in parts]) == pytest.approx(whole.loss, rel=1e-6)
    np.testing.assert_allclose(np.mean([part.slope for part in parts], 0), whole.slope, rtol=1e-4, atol=1e-9)
    assert not parts[1].slope[:2].any() and parts[1].slope[2:4].any()


PROGRAM = """
import sys, numpy as np
sys.path.insert(0, sys.argv[1])
import test_charge as t
sensor, gain = t.SENSORS["mosaic"], np.ones((t.HEIGHT, t.WIDTH), np.float32)
frames, back = t.recorded(sensor, gain), t.back(t.STEP)
found = t.ChargeLoss(sensor, 1)(t.image(3) * np.float32(1.1), frames, back, gain, floor=0.01)
np.save(sys.argv[2], found.slope)
"""


@pytest.mark.parametrize("level", ["baseline", "avx2"])
def test_instruction_sets_agree(level: str, tmp_path: Path) -> None:
    sensor, gain = SENSORS["mosaic"], np.ones((HEIGHT, WIDTH), np.float32)
    frames = recorded(sensor, gain)
    here = ChargeLoss(sensor, 1)(image(3) * np.float32(1.1), frames, back(STEP), gain, floor=0.01).slope
    out = tmp_path / "slope.npy"
    command = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), str(out)]
    run = subprocess.run(command, env=os.environ | {"SPIKED_SIMD": level}, capture_output=True, text=True, check=False)
    if "is not an instruction set of this machine" in run.stderr:
        pytest.skip(f"this machine has no {level}")
    assert run.returncode == 0, run.stderr
    np.testing.assert_allclose(np.load(out), here, atol=1e-5 * float(np.abs(here).max()))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": np.zeros((FRAMES, 3), np.uint8)}, "frames are"),
        ({"frames": np.zeros((FRAMES, WIDTH * HEIGHT // 8), np.float32)}, "not float32"),
        ({"frames": np.zeros((65, WIDTH * HEIGHT // 8), np.uint8)}, "at most 64"),
        ({"displacements": np.zeros((FRAMES, 2, 2, 2), np.float32)}, "cover the sensor"),
        ({"gain": np.ones((3, 3), np.float32)}, "sensor's size"),
        ({"floor": 0.0}, "positive"),
        ({"every": 2, "phase": 2}, "one of every"),
        ({"image": np.zeros((1, 1), np.float32)}, "at least 2x2"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, object], words: str) -> None:
    sensor = SENSORS["grey"]
    given: dict[str, object] = {
        "image": image(1),
        "frames": np.zeros((FRAMES, sensor.frame_bytes), np.uint8),
        "displacements": back(STEP),
        "gain": np.ones((HEIGHT, WIDTH), np.float32),
        "floor": 0.01,
    }
    with pytest.raises(ConfigurationError, match=words):
        ChargeLoss(sensor, 1)(**(given | change))  # type: ignore[arg-type]
