"""What the pixels tell of a colour mosaic."""

from dataclasses import replace
from pathlib import Path

import pytest

from spiked.recon.frontend.mosaic_check import contradicts, detect, find_green, mosaic_warning, recorded_mosaic_warning
from spiked.recon.frontend.windowing import Windows
from spiked.recording import open_recording
from spiked.sensor import Image, Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

STREAMS = Path(__file__).parents[2].parent / "shared" / "streams"


def seen(mosaic: Mosaic | None) -> Image:
    sensor = Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 60), mosaic=mosaic)
    camera = SimulatedCamera(sensor, seed=2, motion=MotionKind.ARC, flow_px=0.3)
    return next(iter(Windows(sensor, 32).feed(0, camera.next_frames(64)))).rate


@pytest.mark.parametrize("mosaic", list(Mosaic))
def test_green_is_found_and_the_wrong_diagonal_contradicted(mosaic: Mosaic) -> None:
    rate = seen(mosaic)
    main = mosaic in (Mosaic.GRBG, Mosaic.GBRG)
    for said in Mosaic:
        agrees = (said in (Mosaic.GRBG, Mosaic.GBRG)) == main
        assert (contradicts(said, rate) is None) == agrees
        found = detect(rate, said)
        assert (found in (Mosaic.GRBG, Mosaic.GBRG)) == main
        assert found is said or not agrees


@pytest.mark.parametrize("mosaic", list(Mosaic))
def test_a_mosaic_that_is_not_stated_is_told_with_what_the_pixels_leave_open(mosaic: Mosaic) -> None:
    warning = mosaic_warning(None, seen(mosaic))
    assert warning is not None
    pairs = [(Mosaic.GRBG, Mosaic.GBRG), (Mosaic.BGGR, Mosaic.RGGB)]
    assert [f"{first} or {second}" in warning for first, second in pairs] == [mosaic in pair for pair in pairs]


@pytest.mark.skipif(not STREAMS.exists(), reason="../shared/streams is absent")
@pytest.mark.parametrize("path", sorted(STREAMS.glob("*/*.dat")), ids=lambda path: path.stem)
def test_real_scenes_are_warned_about_if_they_are_in_colour(path: Path) -> None:
    recording = open_recording(path)
    grey = replace(recording, sensor=replace(recording.sensor, mosaic=None))
    assert (recorded_mosaic_warning(grey) is not None) == (recording.sensor.mosaic is not None)
    assert recorded_mosaic_warning(recording) is None


def test_a_flipped_sensor_is_put_right_with_its_colours() -> None:
    """Read from the other end of its columns, a BGGR sensor is a GRBG one."""
    assert detect(seen(Mosaic.GRBG), Mosaic.BGGR) is Mosaic.GRBG
    assert detect(seen(Mosaic.RGGB), Mosaic.GBRG) is Mosaic.RGGB


def test_a_grey_sensor_has_no_mosaic() -> None:
    rate = seen(None)
    assert find_green(rate) is None
    assert mosaic_warning(None, rate) is None
    assert detect(rate, None) is None and contradicts(Mosaic.BGGR, rate) is None
