"""The simulated sensor fires like the real ones, its noise terms have their stated size, and its bits repeat."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import BitOrder, Layout, Sensor
from spiked.simulate import GainStep, Lighting, PixelMaps, SensorNoise, SpikeSensor
from spiked.simulate.sensor import thermal_reset_noise

CALIBRATION = Path(__file__).resolve().parents[3] / "shared" / "real" / "calibration_400x250.npz"
SENSOR = Sensor(64, 40, 20000.0)


def expose(spikes: SpikeSensor, radiance: NDArray[np.float32] | float, count: int) -> NDArray[np.uint8]:
    """Upright bits [count, height, width] of a constant radiance."""
    sensor = spikes.sensor
    image = np.broadcast_to(np.float32(radiance), (sensor.height, sensor.width)).astype(np.float32)
    return upright(sensor, spikes.expose(image, image, np.zeros(count, np.float32)))


def upright(sensor: Sensor, stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
    rows = stored.reshape(len(stored), sensor.height, sensor.row_stride)[:, :, : sensor.row_bytes]
    bits = np.unpackbits(rows, axis=2, bitorder="little" if sensor.bit_order is BitOrder.LSB else "big")
    return bits[:, ::-1] if sensor.flipped else bits


def ramp(low: float, high: float) -> NDArray[np.float32]:
    return np.linspace(low, high, 64 * 40, dtype=np.float32).reshape(40, 64)


@pytest.mark.parametrize("radiance", [0.02, 0.15, 0.5, 0.9])
def test_the_mean_rate_is_the_radiance(radiance: float) -> None:
    noise = SensorNoise(dark=0.0, dark_spread=0.0)
    assert expose(SpikeSensor(SENSOR, 1, noise), radiance, 3000).mean() == pytest.approx(radiance, rel=0.005)


@pytest.mark.parametrize("frames", [4, 8, 32, 64])
def test_the_count_in_a_window_varies_like_that_of_real_clips(frames: int) -> None:
    """0.10 to 0.25 for every window length: a clock-quantised ramp, not a binomial."""
    bits = expose(SpikeSensor(SENSOR, 2), ramp(0.1, 0.35), frames * 40)
    counts = bits.reshape(40, frames, 40, 64).sum(1)
    assert 0.10 < counts.var(0, ddof=1).mean() < 0.25


def test_intervals_jitter_like_those_of_real_clips() -> None:
    bits = expose(SpikeSensor(SENSOR, 3), ramp(0.1, 0.35), 1500).reshape(1500, -1)
    spread = [np.diff(np.flatnonzero(bits[:, pixel])).std() for pixel in range(0, bits.shape[1], 5)]
    assert 0.33 < np.mean(spread) < 0.42


def test_without_noise_no_charge_is_lost() -> None:
    bits = expose(SpikeSensor(SENSOR, 4, SensorNoise.none()), ramp(0.05, 0.95), 1000)
    assert np.abs(bits.sum(0) - 1000 * ramp(0.05, 0.95)).max() <= 1.01


def test_excess_charge_of_a_saturated_frame_is_lost() -> None:
    spikes = SpikeSensor(SENSOR, 5, SensorNoise.none())
    assert expose(spikes, 3.7, 50).all()
    assert not expose(spikes, 0.0, 50).any()


def test_phases_are_uniform_at_the_start() -> None:
    bits = expose(SpikeSensor(SENSOR, 6, SensorNoise.none()), 0.01, 100)
    first = bits.argmax(0)
    assert bits.any(0).mean() > 0.98
    assert np.abs(np.histogram(first, 10, (0, 100))[0] / 2560 - 0.1).max() < 0.03


def test_shot_noise_is_poisson_in_electrons() -> None:
    noise = replace(SensorNoise.none(), electrons_a_spike=100.0)
    counts = expose(SpikeSensor(SENSOR, 7, noise), 0.5, 2000).sum(0)
    assert counts.var() == pytest.approx(1000 / 100 + 1 / 6, rel=0.12)


def test_jitter_is_drawn_anew_at_each_spike() -> None:
    noise = replace(SensorNoise.none(), threshold_jitter=0.04, reset_noise=0.03)
    counts = expose(SpikeSensor(SENSOR, 8, noise), 0.5, 2000).sum(0)
    assert counts.var() == pytest.approx(1000 * 0.05**2 + 1 / 6, rel=0.12)


def test_defaults_are_those_of_the_streams() -> None:
    noise = SensorNoise()
    assert noise.spike_jitter == pytest.approx(0.01, rel=0.01)
    assert thermal_reset_noise(4000.0) == pytest.approx(0.00254, rel=0.01)
    threshold = SpikeSensor(Sensor(400, 248, 20000.0), 9).threshold
    assert threshold.std() == pytest.approx(0.02, rel=0.02)
    assert threshold.mean() == pytest.approx(1, abs=5e-4)


def test_the_dark_current_alone_makes_its_spikes() -> None:
    assert expose(SpikeSensor(SENSOR, 10), 0.0, 4000).mean() == pytest.approx(0.002, rel=0.02)


def test_hot_pixels_fire_in_the_dark_and_dead_ones_never() -> None:
    noise = SensorNoise(hot_share=0.05, dead_share=0.1)
    spikes = SpikeSensor(SENSOR, 11, noise)
    dark = expose(spikes, 0.0, 200).mean(0)
    bright = expose(spikes, 0.8, 200).mean(0)
    assert (bright == 0).mean() == pytest.approx(0.1, abs=0.02)
    assert (dark > 0.1).mean() == pytest.approx(0.045, abs=0.015)


def test_a_lamp_and_the_mains_change_the_rate() -> None:
    lighting = Lighting(flicker=0.3, flicker_hz=100.0, steps=(GainStep(400, 0.5),))
    rates = expose(SpikeSensor(SENSOR, 12, lighting=lighting), 0.4, 800).reshape(8, 100, -1).mean((1, 2))
    half = 0.3 * 2 / np.pi  # a flicker of 200 frames: mean of half a sine wave
    expected = 0.4 * np.array([1 + half, 1 - half] * 2 + [0.5 + half / 2, 0.5 - half / 2] * 2) + 0.002
    assert rates == pytest.approx(expected, rel=0.01)


def test_the_same_seed_gives_the_same_bits_in_calls_of_any_size_at_any_thread_count() -> None:
    image = ramp(0.05, 0.9)
    weights = np.linspace(0, 1, 60, dtype=np.float32)
    whole = SpikeSensor(SENSOR, 13).expose(image, image[::-1].copy(), weights)
    parts = SpikeSensor(SENSOR, 13, threads=3)
    cut = [parts.expose(image, image[::-1].copy(), part) for part in np.split(weights, [1, 8, 33])]
    assert np.array_equal(whole, np.concatenate(cut))
    assert not np.array_equal(whole, SpikeSensor(SENSOR, 14).expose(image, image[::-1].copy(), weights))


@pytest.mark.parametrize("layout", Layout)
@pytest.mark.parametrize("order", BitOrder)
@pytest.mark.parametrize("flipped", [True, False])
def test_every_way_of_storing_holds_the_same_picture(layout: Layout, order: BitOrder, flipped: bool) -> None:
    sensor = Sensor(64, 40, 20000.0, layout, order, flipped)
    stored = SpikeSensor(sensor, 15).expose(ramp(0, 1), ramp(0, 1), np.zeros(30, np.float32))
    reference = SpikeSensor(SENSOR, 15).expose(ramp(0, 1), ramp(0, 1), np.zeros(30, np.float32))
    assert np.array_equal(upright(sensor, stored), upright(SENSOR, reference))
    if layout is Layout.ROW_TAGGED:
        tags = stored.reshape(30, 40, 10)[:, :, 8:].copy().view("<u2")[..., 0]
        assert np.array_equal(tags, np.tile(np.arange(40), (30, 1)))


@pytest.mark.skipif(not CALIBRATION.exists(), reason="needs ../shared/real")
def test_a_real_calibration_gives_its_fixed_pattern() -> None:
    maps = PixelMaps.read_calibration(CALIBRATION)
    sensor = Sensor(400, 250, 20000.0)
    rates = expose(SpikeSensor(sensor, 16, SensorNoise.none(), maps=maps), 0.3, 400).mean(0)
    assert np.abs(rates - np.minimum(0.3 * maps.gain + maps.dark, 1)).max() < 0.006
    with pytest.raises(ConfigurationError, match="do not fit"):
        SpikeSensor(SENSOR, 16, maps=maps)


@pytest.mark.parametrize("wrong", [{"dark": -1.0}, {"hot_share": 1.5}, {"threshold_jitter": float("nan")}])
def test_impossible_noise_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError):
        SensorNoise(**wrong)
