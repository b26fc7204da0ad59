"""What a camera is, as options: from text, from JSON, and as a sensor."""

from dataclasses import replace

import pytest
from pydantic import ConfigDict, ValidationError

from spiked.camera import CameraFiles, CameraOptions, Pinhole, StoredCameraOptions
from spiked.errors import ConfigurationError
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Sensor

BASE = Sensor(400, 250, 20_000.0, intrinsics=Intrinsics(300, 300, 200, 125))
STATED = {
    "rate": "40000",
    "mosaic": "BGGR",
    "flip": "false",
    "intrinsics": "400,401,199.5,124",
    "width": "640",
    "height": "360",
    "layout": "row-tagged",
    "bit_order": "msb",
}


class StrictOptions(StoredCameraOptions, CameraFiles):
    model_config = ConfigDict(strict=True)


def test_text_says_all_that_a_sensor_is() -> None:
    sensor = StoredCameraOptions.model_validate(STATED).sensor(BASE)
    optics = Intrinsics(400, 401, 199.5, 124)
    assert sensor == Sensor(640, 360, 40_000.0, Layout.ROW_TAGGED, BitOrder.MSB, False, Mosaic.BGGR, optics)


def test_what_is_not_stated_stays() -> None:
    base = replace(BASE, mosaic=Mosaic.GRBG, flipped=False)
    assert CameraOptions().sensor(base) == base
    assert CameraOptions(rate=1000).sensor(base) == replace(base, frame_rate_hz=1000)


def test_optics_of_another_size_are_dropped() -> None:
    assert StoredCameraOptions(width=800, height=500).sensor(BASE).intrinsics is None
    wide = StoredCameraOptions(width=800, height=500, fov=90).sensor(BASE).intrinsics
    assert wide is not None and wide.fx == pytest.approx(400)


def test_two_focal_lengths_are_refused() -> None:
    with pytest.raises(ValidationError, match="give one of them"):
        CameraOptions(fov=60, intrinsics=Pinhole(fx=1.0, fy=1.0, cx=0.0, cy=0.0))


@pytest.mark.parametrize("text", ["1,2,3", "1,2,3,x", "0,1,2,3", "1,1,nan,1", ""])
def test_intrinsics_are_four_numbers(text: str) -> None:
    with pytest.raises(ValidationError):
        CameraOptions.model_validate({"intrinsics": text})


def test_an_impossible_size_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="multiple of 8"):
        StoredCameraOptions(width=12).sensor(BASE)


@pytest.mark.parametrize("field", [{"rate": "9"}, {"flipped": "true"}, {"flipped": 1}, {"width": "8"}, {"fov": "9"}])
def test_requests_take_no_text_for_numbers(field: dict[str, object]) -> None:
    StoredCameraOptions.model_validate(field)
    with pytest.raises(ValidationError):
        StrictOptions.model_validate(field)
