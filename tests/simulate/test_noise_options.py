"""Noise, defects and flicker are options of `spiked simulate` and of `sim:`, with one meaning: the same bits."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from spiked_driver import Chunk, open_source
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import SpikedError
from spiked.recording import open_recording
from spiked.sensor import Response
from spiked.simulate import NoiseOptions, SensorNoise
from spiked.simulate.sensor import thermal_reset_noise

FRAMES, WIDTH, HEIGHT, RATE_HZ = 1000, 64, 48, 20_000.0
PERFECT = (
    "electrons_a_spike=1e12&reset_noise=0&threshold_jitter=0&dark=0&dark_spread=0&capacitance_mismatch=0&reset_bias=0"
)


@cache
def of_source(options: str) -> NDArray[np.uint8]:
    """Bits [frames, height, width], as stored, of `sim:`."""
    source = open_source(f"sim:?pace=0&seed=3&width={WIDTH}&height={HEIGHT}&{options}")
    source.open()
    view = np.zeros((FRAMES, source.sensor.frame_bytes), np.uint8)
    assert source.read_into(view) == Chunk(0, FRAMES)
    return np.unpackbits(view, axis=1, bitorder="little").reshape(FRAMES, HEIGHT, WIDTH)


def of_command(options: str) -> NDArray[np.uint8]:
    """The same of `spiked simulate`."""
    with TemporaryDirectory() as folder:
        flags = [word for pair in options.split("&") for word in ("--" + pair).replace("_", "-").split("=")]
        size = ["--width", f"{WIDTH}", "--height", f"{HEIGHT}", "--frames", f"{FRAMES}", "--views", "0", "--seed", "3"]
        done = CliRunner().invoke(app, ["simulate", "-o", f"{folder}/room", *size, *flags])
        assert done.exit_code == 0, done.output
        stored = np.array(open_recording(Path(folder) / "room" / "simulated.dat").read(0, FRAMES))
    return np.unpackbits(stored, axis=1, bitorder="little").reshape(FRAMES, HEIGHT, WIDTH)


@pytest.mark.parametrize(
    "options",
    [
        "electrons_a_spike=40&temperature_k=400&swing_v=0.5&threshold_jitter=0.03&dark=0.05&dark_spread=0.01",
        "capacitance_mismatch=0.1&reset_bias=0.1&hot_share=0.03&hot_rate=0.4&dead_share=0.02&flicker=0.5&flicker_hz=300",
    ],
)
def test_command_and_source_mean_the_same(options: str) -> None:
    assert np.array_equal(of_command(options), of_source(options))


def test_left_out_they_are_those_of_a_real_sensor() -> None:
    assert NoiseOptions().noise() == SensorNoise()


def test_shot_noise_is_that_of_the_electrons() -> None:
    perfect, grainy = (of_source(PERFECT.replace("1e12", electrons)).sum(0) for electrons in ("1e12", "20"))
    excess = np.var(grainy.astype(np.int64) - perfect)
    assert excess == pytest.approx(perfect.mean() / 20 + 1 / 6, rel=0.15)


@pytest.mark.parametrize("option", ["reset_noise", "threshold_jitter"])
def test_jitter_is_drawn_at_each_spike(option: str) -> None:
    perfect, jittery = (of_source(PERFECT.replace(f"{option}=0", f"{option}={size}")).sum(0) for size in (0, 0.2))
    assert np.var(jittery.astype(np.int64) - perfect) == pytest.approx(perfect.mean() * 0.04 + 1 / 6, rel=0.15)


def test_a_hot_sensor_resets_with_more_noise() -> None:
    """Eq 16: the voltage's deviation is sqrt(k T / C), so it doubles from 300 to 1200 K, as from 4000 to 1000 e-."""
    cold, warm = (NoiseOptions(temperature_k=kelvin).noise().reset_noise for kelvin in (200, 800))
    assert warm == pytest.approx(2 * cold)
    assert NoiseOptions(electrons_a_spike=1000).noise().reset_noise == thermal_reset_noise(1000)
    assert NoiseOptions(swing_v=0.25).noise().reset_noise == pytest.approx(2 * thermal_reset_noise(4000))
    assert NoiseOptions(reset_noise=0.5, temperature_k=200).noise().reset_noise == 0.5


def test_the_dark_rate_has_its_mean_and_spread() -> None:
    light, darker = (of_source(PERFECT.replace("dark=0&dark_spread=0", dark)).mean(0) for dark in
                     ("dark=0&dark_spread=0", "dark=0.1&dark_spread=0.02"))  # fmt: skip
    below = light < 0.8  # brighter pixels fire in nearly every frame
    assert (darker - light)[below].mean() == pytest.approx(0.1, rel=0.02)
    assert (darker - light)[below].std() == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(("option", "size"), [("capacitance_mismatch", 0.05), ("reset_bias", 0.05 * np.sqrt(3))])
def test_thresholds_have_a_fixed_pattern(option: str, size: float) -> None:
    """Eq 18, and the uniform bias after it: the standard deviation of both is 5 %."""
    even, uneven = (of_source(PERFECT.replace(f"{option}=0", f"{option}={s}")).mean(0) for s in (0, size))
    bright = even > 0.1
    assert (even / np.maximum(uneven, 1e-9))[bright].std() == pytest.approx(0.05, rel=0.07)


def test_hot_and_dead_pixels_are_as_many_as_stated() -> None:
    light = of_source(PERFECT).mean(0)
    defects = of_source(PERFECT + "&hot_share=0.05&hot_rate=0.4&dead_share=0.1").mean(0)
    assert ((defects - light) > 0.1).mean() == pytest.approx(0.05 * 0.9, abs=0.012)
    assert (defects == 0).mean() == pytest.approx(0.1, abs=0.017)


def test_light_flickers_with_its_frequency_and_depth() -> None:
    rate = of_source(PERFECT + "&flicker=0.4&flicker_hz=500").mean((1, 2)) / of_source(PERFECT).mean((1, 2)).mean()
    spectrum = 2 * np.abs(np.fft.rfft(rate)) / FRAMES
    peak = 1 + int(spectrum[1:].argmax())
    assert peak * RATE_HZ / FRAMES == pytest.approx(500)
    assert spectrum[peak] == pytest.approx(0.4, rel=0.05)


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ("dark=-1", "dark"),
        ("hot_share=1.5", "hot_share"),
        ("electrons_a_spike=0", "electrons_a_spike"),
        ("flicker=1", "flicker"),
        ("flicker_hz=0", "flicker_hz"),
        ("temperature_k=nan", "temperature_k"),
        ("temperature=300", "no option temperature"),
        ("response=bernoulli&reset_bias=0.1", "no threshold: leave out reset_bias"),
    ],
)
def test_what_cannot_be_is_refused_by_name(wrong: str, problem: str) -> None:
    with pytest.raises(SpikedError, match=problem):
        open_source(f"sim:?{wrong}")
    flags = [word for pair in wrong.split("&") for word in ("--" + pair).replace("_", "-").split("=")]
    done = CliRunner().invoke(app, ["simulate", "-o", "nowhere", "--frames", "1", *flags])
    assert done.exit_code != 0
    assert not Path("nowhere").exists()


def test_a_single_photon_camera_has_dark_counts_and_defects() -> None:
    assert NoiseOptions(dark=0.1, hot_share=0.1, flicker=0.1).checked(Response.BERNOULLI).dark == 0.1
    with pytest.raises(ValidationError):
        NoiseOptions(darkness=0.1)  # type: ignore[call-arg]
