"""What the pixels tell of a colour mosaic."""

from dataclasses import replace
from pathlib import Path

import pytest

from spiked.recon.frontend.mosaic_check import contradicts, detect, find_green, mosaic_warning, recorded_layout_warnings
from spiked.recon.frontend.windowing import Windows
from spiked.recording import open_recording
from spiked.recording.reader import REVERSED_BITS
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
    assert bool(recorded_layout_warnings(grey)) == (recording.sensor.mosaic is not None)
    assert recorded_layout_warnings(recording) == []


VARIANTS = [
    (name, upright, msb, stated)
    for name, mosaics in (("living", (None, Mosaic.BGGR)), ("camp_color", (None, Mosaic.BGGR)))
    for upright in (False, True)
    for msb in (False, True)
    for stated in mosaics
]


@pytest.mark.skipif(not STREAMS.exists(), reason="../shared/streams is absent")
@pytest.mark.parametrize(("name", "upright", "msb", "stated"), VARIANTS)
def test_no_orientation_and_no_mosaic_is_silently_wrong(
    tmp_path: Path, name: str, upright: bool, msb: bool, stated: Mosaic | None
) -> None:
    """Files without a sidecar, their rows either way up and their bits in either order, with and without a mosaic."""
    true = open_recording(STREAMS / name / f"{name}.dat")
    frames = true.read(0, 80).reshape(80, true.sensor.height, -1)
    frames = frames[:, ::-1] if upright else frames
    path = tmp_path / "found.dat"
    (REVERSED_BITS[frames] if msb else frames).tofile(path)
    size = {"width": true.sensor.width, "height": true.sensor.height}
    found = open_recording(path, **size, mosaic=stated)
    assert any("if writing in a picture reads mirrored, give --upright" in line for line in found.questions)
    told = recorded_layout_warnings(found)
    if msb:
        assert len(told) == 1 and "give --bit-order msb" in told[0]
        return
    if name == "living":  # a grey sensor
        assert told == [] if stated is None else "the pixels show none" in told[0]
    elif stated is None:
        pair = "GRBG or GBRG" if upright else "BGGR or RGGB"
        assert f"state mosaic {pair}" in told[0]
    elif upright:  # the mosaic is right for rows that come bottom-up
        assert "green is where GRBG has it" in told[0] and "the rows come the other way up" in told[0]
        put_right = open_recording(path, **size, mosaic=stated, flipped=False)
        assert put_right.questions == () and recorded_layout_warnings(put_right) == []
    else:
        assert told == []


def test_a_flipped_sensor_is_put_right_with_its_colours() -> None:
    """Read from the other end of its columns, a BGGR sensor is a GRBG one."""
    assert detect(seen(Mosaic.GRBG), Mosaic.BGGR) is Mosaic.GRBG
    assert detect(seen(Mosaic.RGGB), Mosaic.GBRG) is Mosaic.RGGB


def test_a_grey_sensor_has_no_mosaic() -> None:
    rate = seen(None)
    assert find_green(rate) is None
    assert mosaic_warning(None, rate) is None
    assert detect(rate, None) is None and contradicts(Mosaic.BGGR, rate) is None
