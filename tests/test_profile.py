"""Camera profiles: found by serial number, checked, written whole, and less than what is stated."""

import json
from pathlib import Path

import pytest

from spiked.camera import CameraOptions, Pinhole, StoredCameraOptions
from spiked.errors import ProfileError
from spiked.profile import CameraProfile, find_profile, profile_path
from spiked.sensor import Mosaic, Sensor

PROFILE = CameraProfile(
    model="M1K40",
    serial="A7",
    width=1000,
    height=1000,
    rate=20_000.0,
    mosaic=Mosaic.BGGR,
    flipped=True,
    intrinsics=Pinhole(fx=900.0, fy=900.0, cx=500.0, cy=500.0),
    calibration=Path("camera.npz"),
)


def test_a_profile_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    PROFILE.write(path)
    assert CameraProfile.read(path) == PROFILE
    assert json.loads(path.read_text())["mosaic"] == "BGGR"
    assert [file.name for file in tmp_path.iterdir()] == ["camera.json"]


def test_a_profile_that_cannot_be_written_leaves_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.mkdir()
    with pytest.raises(ProfileError, match="cannot be written"):
        PROFILE.write(path)
    assert [file.name for file in tmp_path.iterdir()] == ["camera.json"]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("{", "JSON"),
        ('{"mosaic": "RGBW"}', "field 'mosaic'"),
        ('{"rate": "20000"}', "field 'rate'"),
        ('{"rate": 0}', "field 'rate'"),
        ('{"lens": "50 mm"}', "field 'lens': Extra inputs"),
        ('{"intrinsics": {"fx": 1, "fy": 1, "cx": 0}}', "field 'intrinsics.cy'"),
        ('{"fov": 50, "intrinsics": {"fx": 1, "fy": 1, "cx": 0, "cy": 0}}', "give one of them"),
    ],
)
def test_a_wrong_profile_is_refused_with_its_field(tmp_path: Path, content: str, told: str) -> None:
    path = tmp_path / "camera.json"
    path.write_text(content)
    with pytest.raises(ProfileError, match="correct the camera profile") as error:
        CameraProfile.read(path)
    assert told in str(error.value) and str(path) in str(error.value)


def test_a_missing_profile_is_told(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="cannot be read: No such file"):
        CameraProfile.read(tmp_path / "camera.json")


def test_what_is_stated_wins_over_the_profile() -> None:
    known = PROFILE.completed(StoredCameraOptions(rate=40_000, mosaic=Mosaic.GRBG))
    assert (known.rate, known.mosaic, known.flipped, known.width) == (40_000, Mosaic.GRBG, True, 1000)
    assert known.intrinsics == PROFILE.intrinsics
    assert PROFILE.completed(CameraOptions(fov=50)).intrinsics is None


def test_a_default_of_a_kind_of_camera_is_not_stated() -> None:
    class Camera(CameraOptions):
        rate: float = 20_000.0

    assert CameraProfile(rate=40_000.0).completed(Camera()).rate == 40_000
    assert CameraProfile(rate=40_000.0).completed(Camera(rate=20_000.0)).rate == 20_000


def test_a_profile_of_another_size_is_refused() -> None:
    PROFILE.check(Sensor(1000, 1000, 20_000.0))
    with pytest.raises(ProfileError, match="of 1000x1000 pixels and the camera of 400x250"):
        PROFILE.check(Sensor(400, 250, 20_000.0))


def test_profiles_are_found_by_serial_number_then_by_address(tmp_path: Path) -> None:
    assert find_profile(tmp_path, "usb0", "A7") is None
    PROFILE.write(profile_path(tmp_path, "usb0", None))
    assert find_profile(tmp_path, "usb0", "A7") == tmp_path / "usb0.json"
    PROFILE.write(profile_path(tmp_path, "usb0", "A7"))
    assert find_profile(tmp_path, "usb0", "A7") == tmp_path / "A7.json"
    assert find_profile(tmp_path, "usb1", "A7") == tmp_path / "A7.json"


def test_a_serial_number_of_many_cameras_names_none(tmp_path: Path) -> None:
    assert profile_path(tmp_path, "usb:2-1", "000000000001").name == "usb%3A2-1.json"


def test_a_name_stays_in_its_folder(tmp_path: Path) -> None:
    for name in ("../../etc/passwd", "pcie:/dev/JR6101", "a" * 4096):
        path = profile_path(tmp_path, name, None)
        assert path.parent == tmp_path
        PROFILE.write(path)


def test_long_addresses_have_files_of_their_own(tmp_path: Path) -> None:
    one, other = (profile_path(tmp_path, "pcie:/" + "a" * 400 + end, None) for end in "bc")
    assert one != other
