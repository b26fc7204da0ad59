"""What the pixels tell of a colour mosaic."""

import pytest

from spiked.recon.frontend.mosaic_check import contradicts, detect, find_green
from spiked.recon.frontend.windowing import Windows
from spiked.sensor import Image, Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, SimulatedCamera


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


def test_a_flipped_sensor_is_put_right_with_its_colours() -> None:
    """Read from the other end of its columns, a BGGR sensor is a GRBG one."""
    assert detect(seen(Mosaic.GRBG), Mosaic.BGGR) is Mosaic.GRBG
    assert detect(seen(Mosaic.RGGB), Mosaic.GBRG) is Mosaic.RGGB


def test_a_grey_sensor_has_no_mosaic() -> None:
    rate = seen(None)
    assert find_green(rate) is None
    assert detect(rate, None) is None and contradicts(Mosaic.BGGR, rate) is None
