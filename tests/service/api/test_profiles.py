"""Camera profiles over HTTP: checked, kept over a restart, and used by captures."""

import json
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from spiked_driver.source_kind import Device
from spiked_service.captures.camera_profiles import of_another_camera
from spiked_service.store.rows import CaptureRow, CaptureState, Origin, Plan

from spiked.calibration import Calibration
from spiked.client import ApiError, ProfileModel, Spiked, StatedCameraModel
from spiked.profile import CameraProfile
from spiked.recording import open_recording, sidecar_path
from spiked.sensor import Sensor
from tests.still_recordings import still

DEVICE = "sim:"
PATH = "devices/sim%3A/profile"


@pytest.fixture
def folder(service: Any) -> Path:
    return Path(service.client.system().data_folder) / "profiles"


def test_a_profile_is_written_read_and_removed(service: Any, folder: Path) -> None:
    assert service.http.get(PATH).status_code == 404
    body = {"model": "toy", "mosaic": "BGGR", "flipped": False, "intrinsics": {"fx": 90, "fy": 90, "cx": 48, "cy": 32}}
    written = service.http.put(PATH, json=body)
    assert written.status_code == 200 and written.json()["file"] == "sim%3A.json"
    assert service.http.get(PATH).json() == written.json()
    assert service.client.profile(DEVICE).mosaic == "BGGR"
    assert CameraProfile.read(folder / "sim%3A.json").intrinsics is not None
    assert service.http.delete(PATH).status_code == 204
    assert service.http.delete(PATH).status_code == 404
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ({"mosaic": "RGBW"}, "mosaic"),
        ({"rate": "20000"}, "rate"),
        ({"fov": 50, "intrinsics": {"fx": 1, "fy": 1, "cx": 0, "cy": 0}}, "give one of them"),
        ({"lens": "50 mm"}, "lens"),
        ({"width": 12, "height": 8}, "multiple of 8"),
        ({"width": 16384, "height": 16384}, "larger than"),
        ({"calibration": "missing.npz"}, "cannot read the calibration"),
        ({"calibration": "/etc/passwd"}, "is not in a folder"),
        ({"calibration": "../" * 9 + "etc/passwd"}, "is not in a folder"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused_and_the_one_before_stays(
    service: Any, folder: Path, body: dict[str, Any], told: str
) -> None:
    service.client.set_profile(DEVICE, ProfileModel(model="before"))
    refused = service.http.put(PATH, json=body)
    assert refused.status_code == 422 and told in refused.text, refused.text
    assert service.client.profile(DEVICE).model == "before"
    assert [file.name for file in folder.iterdir()] == ["sim%3A.json"]
    service.http.delete(PATH)


def test_a_capture_takes_the_profile_and_a_request_wins_over_it(service: Any, folder: Path) -> None:
    image = np.full((64, 96), 1.0, np.float32)
    Calibration(image, 0 * image, np.zeros(image.shape, bool)).write(folder / "toy.npz")
    profile = ProfileModel(mosaic="GRBG", flipped=False, fov=70, width=96, height=64, calibration="toy.npz")
    service.client.set_profile(DEVICE, profile)
    try:
        for camera, mosaic, fx in ((None, "GRBG", 68.6), (StatedCameraModel(mosaic="RGGB", fov=90), "RGGB", 48)):
            started = service.client.start_capture("sim:", frames=64, reconstruct=False, camera=camera)
            sensor = service.client.wait_for_capture(started.id, 60).sensor
            assert (sensor.width, sensor.mosaic) == (96, mosaic)
            assert sensor.intrinsics.fx == pytest.approx(fx, abs=0.1)
    finally:
        service.http.delete(PATH)
        (folder / "toy.npz").unlink()


@pytest.mark.parametrize("option", ["profile", "calibration"])
def test_requests_name_no_files_outside_the_folders(service: Any, option: str) -> None:
    for body in ({"source": f"sim:?{option}=/etc/passwd"}, {"source": "sim:", "camera": {option: "/etc/passwd"}}):
        refused = service.http.post("captures", json=body)
        assert refused.status_code == 422 and "is not in a folder" in refused.text


def test_a_profile_survives_a_restart(tmp_path: Path, daemon_class: Any) -> None:
    for written in (True, False):
        daemon = daemon_class(folder=tmp_path)
        try:
            client = Spiked(daemon.address)
            if written:
                client.set_profile(DEVICE, ProfileModel(model="toy", mosaic="GBRG"))
            assert client.profile(DEVICE).mosaic == "GBRG"
            client.close()
        finally:
            daemon.close()
        time.sleep(0.1)


def test_a_device_that_is_not_there_has_no_profile(service: Any) -> None:
    with pytest.raises(ApiError, match="there is no device"):
        service.client.profile("usb9")


SENSOR = Sensor(96, 64, 20_000.0)


def test_a_device_is_calibrated_by_captures(service: Any, folder: Path, tmp_path: Path) -> None:
    client = service.client
    dark, flat = (client.upload(still(tmp_path / f"{light}.dat", SENSOR, light)).id for light in (0, 0.2))
    client.set_profile(DEVICE, ProfileModel(model="toy", width=96, height=64))
    try:
        assert service.http.get(f"{PATH}/calibration").status_code == 404
        first = client.calibrate(DEVICE, dark=dark)
        assert (first.profile.model, first.measured.gain_spread) == ("toy", 0.0)
        assert 0 < first.measured.useless < 60 and 0.001 < first.measured.dark_rate < 0.003
        both = client.calibrate(DEVICE, flat=flat)  # the dark rates of before stay
        assert both.measured.dark_rate == first.measured.dark_rate
        assert both.measured.useless > first.measured.useless and both.measured.gain_spread > 0.01
        assert [file.name for file in folder.glob("*.npz")] == [str(both.profile.calibration)]
        whole = Calibration.read(folder / str(both.profile.calibration))
        flags = {
            "useless": (whole.dead, 255, 255),
            "dark": (whole.dark > 0.1, 200, 255),
            "gain": (whole.dead, 127, 128),
        }
        for kind, (marked, least, most) in flags.items():
            answer = service.http.get(f"{PATH}/calibration?kind={kind}")
            picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
            assert picture is not None and picture.shape == (64, 96)
            assert (picture[marked] >= least).all() and (picture[marked] <= most).all() and marked.any()
            tag = {"if-none-match": answer.headers["etag"]}
            assert service.http.get(f"{PATH}/calibration?kind={kind}", headers=tag).status_code == 304
        taken = client.wait_for_capture(client.start_capture("sim:", frames=64, reconstruct=False).id, 60)
        sidecar = service.http.get(f"captures/{taken.id}/recording/sidecar").json()
        assert sidecar["calibration"] == "calibration.npz"
    finally:
        service.http.delete(PATH)
    assert list(folder.iterdir()) == []


def test_a_capture_of_another_camera_does_not_calibrate_a_device(service: Any, folder: Path) -> None:
    client = service.client
    started = client.start_capture("sim:?width=96&height=64&seed=3", frames=400, reconstruct=False)
    other = client.wait_for_capture(started.id, 60).id
    refused = service.http.post(f"{PATH}:calibrate", json={"dark": other})
    assert refused.status_code == 409 and "is of the device sim:?" in refused.text, refused.text
    assert list(folder.iterdir()) == []


def test_serial_numbers_tell_cameras_apart(tmp_path: Path) -> None:
    path = still(tmp_path / "serial.dat", SENSOR, 0)
    sidecar = sidecar_path(path)
    sidecar.write_text(json.dumps({**json.loads(sidecar.read_text()), "profile": {"serial": "A8"}}))
    recording = open_recording(path)
    live = CaptureRow("a", Origin.LIVE, Plan("usb0"), CaptureState.COMPLETE, datetime.now(UTC))
    for serial, source, told in (
        ("A8", "usb:2-4", None),
        ("A9", "usb0", "camera A8"),
        (None, "usb0", None),
        ("000000000001", "pcie:/dev/JR6101", "the device usb0"),
    ):
        device = Device(source, source.partition(":")[0], "", serial=serial)
        assert of_another_camera(live, recording, device) == told
    upload = replace(live, origin=Origin.UPLOAD)
    assert of_another_camera(upload, recording, Device("pcie:/dev/JR6101", "pcie", "")) is None


def test_what_cannot_calibrate_a_device_leaves_it_as_it_was(service: Any, folder: Path, tmp_path: Path) -> None:
    client = service.client
    flat = client.upload(still(tmp_path / "a.dat", SENSOR, 0.2)).id
    other = client.upload(still(tmp_path / "b.dat", Sensor(64, 64, 20_000.0), 0)).id
    scene = client.wait_for_capture(client.start_capture("sim:", frames=400, reconstruct=False).id, 60).id
    client.set_profile(DEVICE, ProfileModel(model="before", width=96, height=64))
    try:
        for body, status, told in (
            ({}, 422, "in the dark"),
            ({"dark": None}, 422, "in the dark"),
            ({"dark": 3}, 422, "dark"),
            ({"dark": "nothing"}, 404, "nothing"),
            ({"dark": scene}, 422, "is not dark"),
            ({"dark": other, "flat": flat}, 422, "they must be of one camera"),
            ({"dark": other}, 422, "96x64"),
        ):
            refused = service.http.post(f"{PATH}:calibrate", json=body)
            assert refused.status_code == status and told in refused.text, refused.text
        assert client.profile(DEVICE) == ProfileModel(model="before", width=96, height=64)
        assert [file.name for file in folder.iterdir()] == ["sim%3A.json"]
    finally:
        service.http.delete(PATH)
