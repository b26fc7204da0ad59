"""Calibrations: what a flat and a dark recording say of each pixel, and what is refused."""

import io
import resource
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from spiked.calibration import Calibration, around, mean_rate
from spiked.errors import CalibrationError
from spiked.recording import Recording, RecordingWriter, open_recording
from spiked.sensor import Mosaic, Response, Sensor
from spiked.simulate import PixelMaps, SensorNoise
from spiked.simulate.sensor import SpikeSensor

SENSOR = Sensor(64, 48, 20000.0)
NOISE = SensorNoise(dark=0.004, dark_spread=0.001, hot_share=0.01, dead_share=0.01)


def record(path: Path, pixels: SpikeSensor, light: float, frames: int = 4000) -> Recording:
    image = np.full((48, 64), light, np.float32)
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(pixels.expose(image, image, np.zeros(frames, np.float32)))
    return open_recording(path)


def uneven() -> SpikeSensor:
    falloff = 1 - 0.3 * np.hypot(*np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 48))) ** 2 / 2
    maps = PixelMaps(falloff.astype(np.float32), np.full((48, 64), 0.004, np.float32))
    return SpikeSensor(SENSOR, 3, NOISE, maps=maps)


def test_gain_dark_rate_and_defects_are_those_of_the_sensor(tmp_path: Path) -> None:
    pixels = uneven()
    measured = Calibration.measure(
        record(tmp_path / "flat.dat", pixels, 0.2), record(tmp_path / "dark.dat", pixels, 0.0)
    )
    useless = (pixels.gain == 0) | (pixels.dark > 0.1)
    assert useless.sum() > 20
    np.testing.assert_array_equal(measured.dead, useless)
    true = pixels.gain / pixels.threshold
    true = true / np.exp(np.log(true[~useless]).mean())
    error = measured.gain[~useless] / true[~useless] - 1
    assert np.std(error) < 0.003 < np.std(true[~useless])
    dark_error = measured.dark[~useless] - (pixels.dark / pixels.threshold)[~useless]
    assert np.abs(dark_error).max() < 0.001


def test_calibrated_light_is_even_and_leaves_dead_pixels_out(tmp_path: Path) -> None:
    pixels = uneven()
    flat = record(tmp_path / "flat.dat", pixels, 0.2)
    measured = Calibration.measure(flat, record(tmp_path / "dark.dat", pixels, 0.0))
    rate = (pixels.gain * 0.3 + pixels.dark) / pixels.threshold
    light, deviation = measured.apply(rate.astype(np.float32), np.full(rate.shape, 0.01, np.float32))
    assert np.std(rate) / np.mean(rate) > 0.05
    assert np.std(light) / np.mean(light) < 0.005
    assert (deviation[measured.dead] > 1).all() and (deviation[~measured.dead] < 0.1).all()


def test_a_calibration_comes_back_from_its_file(tmp_path: Path) -> None:
    measured = Calibration.measure(record(tmp_path / "flat.dat", uneven(), 0.2), None)
    measured.write(tmp_path / "camera.npz")
    again = Calibration.read(tmp_path / "camera.npz")
    for name in ("gain", "dark", "dead"):
        np.testing.assert_array_equal(getattr(again, name), getattr(measured, name))
    with pytest.raises(CalibrationError, match="64x48"):
        again.check(Sensor(400, 250, 20000.0))
    whole, before = (tmp_path / "camera.npz").read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))  # as a full disk
    try:
        with pytest.raises(CalibrationError, match="cannot write"):
            measured.write(tmp_path / "camera.npz")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (tmp_path / "camera.npz").read_bytes() == whole and not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("light", "frames", "told"), [(0.001, 4000, "too dark"), (3.0, 4000, "saturated"), (0.2, 50, "50 frames")]
)
def test_unsuitable_recordings_are_refused(tmp_path: Path, light: float, frames: int, told: str) -> None:
    pixels = SpikeSensor(SENSOR, 1, SensorNoise())
    with pytest.raises(CalibrationError, match=told):
        Calibration.measure(record(tmp_path / "flat.dat", pixels, light, frames), None)


def test_a_bright_dark_recording_is_refused(tmp_path: Path) -> None:
    pixels = SpikeSensor(SENSOR, 1, SensorNoise())
    flat = record(tmp_path / "flat.dat", pixels, 0.2)
    with pytest.raises(CalibrationError, match="not dark"):
        Calibration.measure(flat, record(tmp_path / "dark.dat", pixels, 0.15))


@pytest.mark.parametrize("kind", [complex, [("a", "f4")], "S4"], ids=str)
def test_arrays_of_no_real_numbers_are_no_calibration(tmp_path: Path, kind: object) -> None:
    np.savez(tmp_path / "c.npz", gain=np.zeros((2, 8), kind), dark=np.zeros((2, 8)), dead=np.zeros((2, 8), bool))
    with pytest.raises(CalibrationError, match="not a calibration"):
        Calibration.read(tmp_path / "c.npz")


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04garbage"])
def test_other_files_are_no_calibrations(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "camera.npz"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=r"camera\.npz"):
        Calibration.read(path)


def packed(**arrays: bytes) -> bytes:
    """An archive of arrays in the `.npy` format."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            archive.writestr(f"{name}.npy", array)
    return content.getvalue()


def npy(descr: str, shape: tuple[int, ...], content: bytes) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
    return file.getvalue() + content


@pytest.mark.parametrize(
    "gain",
    [
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + bytes(99),
        npy("<f4", (10**5, 10**5), bytes(4096)),
        npy("<f4", (-2, -2), bytes(16)),
        npy("<U4", (1, 1), b"a\0\0\0" * 4),
        npy("<f4", (2, 2), bytes(7)),
        b"\x93NUMPY\x01\x00\x04\x00{(\n ",
    ],
)
def test_hostile_archives_are_no_calibrations(tmp_path: Path, gain: bytes) -> None:
    rest = npy("<f4", (1, 1), bytes(4))
    (tmp_path / "camera.npz").write_bytes(packed(gain=gain, dark=rest, dead=rest))
    with pytest.raises(CalibrationError, match=r"camera\.npz is not a calibration"):
        Calibration.read(tmp_path / "camera.npz")


@pytest.mark.parametrize("at", range(40, 400, 24))
def test_a_calibration_with_a_wrong_byte_is_an_error_or_another_calibration(tmp_path: Path, at: int) -> None:
    image = npy("<f4", (16, 16), np.ones(256, "<f4").tobytes())
    whole = bytearray(packed(gain=image, dark=image, dead=image))
    whole[at % len(whole)] ^= 0x55
    (tmp_path / "camera.npz").write_bytes(whole)
    with suppress(CalibrationError):
        Calibration.read(tmp_path / "camera.npz")


def test_a_missing_pixel_takes_the_mean_of_the_nearest_good_ones() -> None:
    image = np.arange(25, dtype=np.float32).reshape(5, 5)
    good = np.ones((5, 5), bool)
    good[2, 2] = False
    image[2, 2] = 1e6
    np.testing.assert_allclose(around(image, good)[2, 2], 12.0)


def test_a_dead_pixel_of_a_mosaic_takes_the_light_of_its_colour() -> None:
    mosaic = Mosaic.GBRG
    colours = np.array([0.1, 0.3, 0.05], np.float32)[mosaic.channels(8, 9)]
    dead = np.zeros((8, 9), bool)
    dead[3, 3], dead[3, 4], dead[4, 4], dead[0, 0] = True, True, True, True
    measured = np.where(dead, np.float32(0.9), colours)
    calibration = Calibration(np.ones_like(colours), np.zeros_like(colours), dead)
    light, deviation = calibration.apply(measured, np.full_like(measured, 0.01), mosaic)
    np.testing.assert_allclose(light, colours, rtol=1e-6)
    np.testing.assert_array_equal(deviation > 1, dead)


def test_a_light_that_hardly_exceeds_the_dark_current_is_refused(tmp_path: Path) -> None:
    maps = PixelMaps(np.ones((48, 64), np.float32), np.full((48, 64), 0.1, np.float32))
    pixels = SpikeSensor(SENSOR, 3, SensorNoise(), maps=maps)
    dark, flat = record(tmp_path / "dark.dat", pixels, 0.0), record(tmp_path / "flat.dat", pixels, 0.15)
    with pytest.raises(CalibrationError, match="more than half of the pixels"):
        Calibration.measure(flat, dark)


def test_a_dark_recording_alone_gives_dark_rates_and_hot_pixels(tmp_path: Path) -> None:
    pixels = uneven()
    dark = record(tmp_path / "dark.dat", pixels, 0.0)
    measured = Calibration.measure(None, dark)
    assert (measured.gain == 1).all()
    np.testing.assert_array_equal(measured.dead, pixels.dark > 0.1)
    assert np.abs(measured.dark - pixels.dark / pixels.threshold)[pixels.gain > 0].max() < 0.001


def test_a_new_dark_frame_keeps_the_gains_of_before_and_the_other_way_round(tmp_path: Path) -> None:
    pixels = uneven()
    flat, dark = record(tmp_path / "flat.dat", pixels, 0.2), record(tmp_path / "dark.dat", pixels, 0.0)
    both = Calibration.measure(flat, dark)
    renewed = Calibration.measure(None, dark, Calibration.measure(flat, None))
    assert float(np.abs(np.log(renewed.gain / both.gain))[~both.dead].max()) < 0.1
    np.testing.assert_array_equal(renewed.dark, both.dark)
    np.testing.assert_array_equal(Calibration.measure(flat, None, Calibration.measure(None, dark)).gain, both.gain)


def test_a_lit_recording_is_not_taken_for_a_dark_one(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="is not dark: pixels fire"):
        Calibration.measure(None, record(tmp_path / "lit.dat", uneven(), 0.1))


def test_a_camera_with_much_dark_current_can_be_calibrated(tmp_path: Path) -> None:
    warm = SpikeSensor(SENSOR, 3, SensorNoise(dark=0.1, dark_spread=0.02))
    measured = Calibration.measure(None, record(tmp_path / "dark.dat", warm, 0.0))
    assert 0.09 < float(np.median(measured.dark)) < 0.11


def test_a_calibration_needs_something_to_measure() -> None:
    with pytest.raises(CalibrationError, match="an even light, one in the dark, or both"):
        Calibration.measure(None, None)


@pytest.mark.parametrize("flux", [0.05, 1.0])
def test_photons_of_a_single_photon_camera_are_counted_by_its_response(tmp_path: Path, flux: float) -> None:
    sensor = Sensor(64, 48, 97_000.0, response=Response.BERNOULLI)
    frames = np.random.default_rng(1).random((6000, 48, 64)) < 1 - np.exp(-flux)
    with RecordingWriter(tmp_path / "flat.dat", sensor) as writer:
        writer.append(np.packbits(frames, axis=2, bitorder="little").reshape(6000, -1))
    rate = mean_rate(open_recording(tmp_path / "flat.dat"))
    assert float(rate.mean()) == pytest.approx(flux, rel=0.01)
