"""Recordings from elsewhere: in chunks, taken up where they broke off, checked in a worker."""

import hashlib
import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from spiked.calibration import Calibration
from spiked.client import ApiError, GeometryModel, IntrinsicsModel, ProfileModel, ReconstructionOptions
from spiked.distortion import Distortion, LensModel
from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.undistortion import Undistortion

from ..survival import moving_recording
from .conftest import Service, write_recording

CHUNK = {"Content-Type": "application/octet-stream"}
SENSOR = Sensor(96, 64, 20_000.0)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write_recording(tmp_path / "garden.dat")
    return tmp_path / "garden.dat"


def announced(service: Any, path: Path, **more: Any) -> str:
    body = {"name": path.name, "bytes": path.stat().st_size, **more}
    answer = service.http.post("uploads", json=body)
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"].endswith(answer.json()["id"])
    return str(answer.json()["id"])


def patch(service: Any, upload: str, offset: int, content: bytes, **headers: str) -> httpx.Response:
    answer: httpx.Response = service.http.patch(
        f"uploads/{upload}", content=content, headers={**CHUNK, "Upload-Offset": str(offset), **headers}
    )
    return answer


def test_an_upload_becomes_a_capture(service: Any, recording: Path) -> None:
    told: list[tuple[int, int]] = []
    capture = service.client.upload(recording, notes="from a friend", progress=lambda *now: told.append(now))
    size = recording.stat().st_size
    assert told[-1] == (size, size)
    assert (capture.origin, capture.state, capture.name, capture.notes) == (
        "upload",
        "complete",
        "garden.dat",
        "from a friend",
    )
    assert capture.recording.sha256 == hashlib.sha256(recording.read_bytes()).hexdigest()
    assert capture.recording.frames == 200
    assert capture.verdict.grade == "good"
    assert service.http.get(f"captures/{capture.id}/recording").content == recording.read_bytes()
    small = service.http.get(f"captures/{capture.id}/thumbnail")
    assert (small.status_code, small.headers["content-type"]) == (200, "image/webp")
    picture = cv2.imdecode(np.frombuffer(small.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None and picture.shape[1] == 200 and picture.std() > 10
    assert service.http.get(f"captures/{capture.id}/thumbnail").headers["etag"] == small.headers["etag"]


def test_an_upload_states_what_was_lost_and_why(service: Any, tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (50, SENSOR.frame_bytes), np.uint8)
    with RecordingWriter(tmp_path / "gaps.dat", SENSOR) as writer:
        for first, count, cause in ((50, 7, "usb"), (107, 3, "disk"), (160, 5, "usb")):
            writer.append(frames)
            writer.gap(first, count, cause)
    recording = service.client.upload(tmp_path / "gaps.dat").recording
    assert (recording.frames, recording.lost) == (150, 15)
    assert recording.lost_by_cause == {"usb": 12, "disk": 3}


def test_what_an_upload_does_not_state_is_asked_wherever_it_goes(service: Any, tmp_path: Path) -> None:
    """Its sidecar, its capture, every reconstruction of it; not after it was stated."""
    stated = moving_recording(tmp_path / "arc.dat")
    bare = tmp_path / "bare" / "arc.dat"
    bare.parent.mkdir()
    bare.write_bytes(stated.read_bytes())
    size = {"width": SENSOR.width, "height": SENSOR.height, "rate": 20_000.0}
    for geometry, asked in ((GeometryModel(**size), True), (GeometryModel(**size, flipped=True), False)):
        capture = service.client.upload(bare, geometry=geometry)
        assert capture.verdict.grade == "good"
        assert any("which way up its rows come" in text for text in capture.warnings) == asked
        job = service.client.start_reconstruction(capture.id, options=ReconstructionOptions(steps=5))
        job = service.client.wait_for_reconstruction(job.id, 120)
        report = service.http.get(f"reconstructions/{job.id}").json()
        assert any("which way up its rows come" in text for text in report["warnings"]) == asked
        content = service.http.get(f"captures/{capture.id}/recording").content
        assert content == bare.read_bytes()


def test_an_upload_can_be_reconstructed(service: Any, tmp_path: Path) -> None:
    capture = service.client.upload(moving_recording(tmp_path / "arc.dat"))
    job = service.client.start_reconstruction(capture.id, options=ReconstructionOptions(steps=5))
    done = service.client.wait_for_reconstruction(job.id, 120)
    assert (done.state, done.reason) == ("complete", "")


def test_a_broken_upload_goes_on_where_it_broke(service: Any, recording: Path) -> None:
    content = recording.read_bytes()
    upload = announced(service, recording, sidecar=json.loads(recording.with_suffix(".json").read_text()))
    assert patch(service, upload, 0, content[:1000]).json()["offset_bytes"] == 1000
    wrong = patch(service, upload, 500, content[500:])
    assert (wrong.status_code, wrong.headers["upload-offset"]) == (409, "1000")
    head = service.http.head(f"uploads/{upload}")
    assert head.headers["upload-offset"] == "1000"
    early = service.http.post(f"uploads/{upload}:complete")
    assert early.status_code == 409
    assert f"1000 of {len(content)}" in early.json()["detail"]
    assert patch(service, upload, 1000, content[1000:] + b"x").status_code == 409
    assert patch(service, upload, 1000, b"").status_code == 200
    assert patch(service, upload, 1000, content[1000:]).json()["offset_bytes"] == len(content)
    done = service.http.post(f"uploads/{upload}:complete")
    assert done.status_code == 201
    assert service.http.post(f"uploads/{upload}:complete").json()["id"] == done.json()["id"]
    assert patch(service, upload, len(content), b"").status_code == 409
    assert upload not in [one["id"] for one in service.http.get("uploads").json()["items"]]
    assert service.http.delete(f"uploads/{upload}").status_code == 204


@pytest.mark.parametrize("length_said", [True, False])
def test_of_a_chunk_that_is_too_long_nothing_stays(daemon: Any, tmp_path: Path, length_said: bool) -> None:
    one = daemon("--set", f"limit_chunk_bytes={2 << 20}")
    upload = one.http.post("uploads", json={"name": "a.dat", "bytes": 5 << 20}).json()["id"]
    part = next((tmp_path / "data" / "uploads").glob("*.part"))
    assert patch(one, upload, 0, bytes(1000)).json()["offset_bytes"] == 1000

    def pieces(size: int) -> Any:
        """Sent without a length."""
        return bytes(size) if length_said else (bytes(65_536) for _ in range(size >> 16))

    def refused(at: int, size: int, status: int) -> None:
        answer = patch(one, upload, at, pieces(size))
        assert answer.status_code == status, answer.text
        assert one.http.get(f"uploads/{upload}").json()["offset_bytes"] == at
        assert part.stat().st_size == at

    refused(1000, 3 << 20, 413)
    at = 1000 + (4 << 20)
    for offset in range(1000, at, 2 << 20):
        assert patch(one, upload, offset, bytes(2 << 20)).status_code == 200
    refused(at, 1 << 20, 409)
    assert patch(one, upload, at, bytes((5 << 20) - at)).json()["offset_bytes"] == 5 << 20


def test_what_is_promised_to_one_upload_is_promised_to_no_other(daemon: Any, tmp_path: Path) -> None:
    one = daemon("--set", f"limit_upload_bytes={2**50}")
    free = one.http.get("system").json()["disk"]["free_bytes"]

    def start_upload(share: float) -> httpx.Response:
        answer: httpx.Response = one.http.post("uploads", json={"name": "a.dat", "bytes": int(share * free)})
        return answer

    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda _: start_upload(0.6), range(8)))
    assert sorted(answer.status_code for answer in answers) == [201] + 7 * [507]
    told = next(answer for answer in answers if answer.status_code == 507).json()["detail"]
    assert "do not fit" in told and f"beside the {0.6 * free / 1e9:.1f} GB that running captures and uploads" in told
    frames = round(0.6 * free / (96 * 64 / 8))
    capture = {"source": "sim:?width=96&height=64", "reconstruct": False, "frames": frames}
    refused = one.http.post("captures", json=capture)
    assert refused.status_code == 507
    assert "this capture needs" in refused.json()["detail"] and "are free for captures" in refused.json()["detail"]
    assert one.http.get("captures").json()["items"] == []
    one.process.kill()  # what was promised is promised by the next service too
    one.process.wait()
    one = daemon("--set", f"limit_upload_bytes={2**50}")
    assert start_upload(0.6).status_code == 507
    (upload,) = one.http.get("uploads").json()["items"]
    assert one.http.delete(f"uploads/{upload['id']}").status_code == 204
    started = one.http.post("captures", json=capture)
    assert started.status_code == 201
    assert start_upload(0.6).status_code == 507, "a running capture's needs are promised too"
    one.http.post(f"captures/{started.json()['id']}:stop")
    deadline = time.monotonic() + 60
    while one.http.get(f"captures/{started.json()['id']}").json()["state"] not in ("complete", "failed"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert start_upload(0.6).status_code == 201


def test_an_upload_survives_the_service(daemon: Any, recording: Path) -> None:
    content = recording.read_bytes()
    one = daemon()
    upload = announced(one, recording, sidecar=json.loads(recording.with_suffix(".json").read_text()))
    patch(one, upload, 0, content[:5000])
    one.process.kill()
    one.process.wait()
    another = daemon()
    assert another.http.get(f"uploads/{upload}").json()["offset_bytes"] == 5000
    assert patch(another, upload, 5000, content[5000:]).status_code == 200
    assert another.http.post(f"uploads/{upload}:complete").status_code == 201


def test_geometry_can_be_said_instead_of_a_sidecar(service: Any, recording: Path) -> None:
    recording.with_suffix(".json").unlink()
    geometry = GeometryModel(
        width=96, height=64, frame_rate_hz=20_000, intrinsics=IntrinsicsModel(fx=90, fy=90, cx=48, cy=32)
    )
    capture = service.client.upload(recording, geometry=geometry)
    assert (capture.sensor.width, capture.sensor.height, capture.sensor.intrinsics.fx) == (96, 64, 90)


def test_a_lens_can_be_said_and_is_undone_on_request(service: Any, recording: Path) -> None:
    recording.with_suffix(".json").unlink()
    optics = {"fx": 90, "fy": 90, "cx": 48, "cy": 32, "distortion": {"model": "opencv", "k1": -0.3, "k2": 0.1}}
    geometry = GeometryModel(
        width=96, height=64, frame_rate_hz=20_000, intrinsics=IntrinsicsModel.model_validate(optics)
    )
    capture = service.client.upload(recording, geometry=geometry)
    assert capture.sensor.intrinsics.distortion.k1 == -0.3
    url = f"captures/{capture.id}/preview"
    seen, straight = (
        cv2.imdecode(np.frombuffer(service.http.get(url, params=query).content, np.uint8), cv2.IMREAD_GRAYSCALE)
        for query in ({"frame": 100, "format": "png"}, {"frame": 100, "format": "png", "undistorted": True})
    )
    k = Intrinsics(90.0, 90.0, 48.0, 32.0, Distortion(LensModel.OPENCV, (-0.3, 0.1)))
    expected = Undistortion.of(k, 96, 64).straighten(seen.astype(np.float32))
    assert np.abs(expected - seen).mean() > 3 * np.abs(expected - straight).mean()


def test_another_file_than_announced_is_told(service: Any, recording: Path) -> None:
    upload = announced(service, recording, sha256="0" * 64)
    patch(service, upload, 0, recording.read_bytes())
    answer = service.http.post(f"uploads/{upload}:complete")
    assert answer.status_code == 422
    assert "SHA-256" in answer.json()["detail"]
    assert service.http.delete(f"uploads/{upload}").status_code == 204


def test_what_is_no_recording_is_told_without_telling_of_the_host(service: Any, tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_bytes(b"\xff\xd8\xff" * 333)
    with pytest.raises(ApiError) as refused:
        service.client.upload(tmp_path / "holiday.jpg")
    assert refused.value.status == 422
    assert "holiday.jpg" in str(refused.value)
    assert "/uploads/" not in str(refused.value) and ".part" not in str(refused.value)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Upload-Offset": "0", "Content-Type": "application/json"}, 415),
        ({"Upload-Offset": "0"}, 415),
        ({**CHUNK, "Upload-Offset": "-1"}, 422),
        ({**CHUNK, "Upload-Offset": "zero"}, 422),
        (CHUNK, 422),
    ],
)
def test_chunks_that_are_none(service: Any, recording: Path, headers: dict[str, str], status: int) -> None:
    upload = announced(service, recording)
    assert service.http.patch(f"uploads/{upload}", content=b"abc", headers=headers).status_code == status
    service.http.delete(f"uploads/{upload}")


@pytest.mark.parametrize(
    "body",
    [
        {"name": "", "bytes": 1},
        {"name": "a\nb", "bytes": 1},
        {"name": "a", "bytes": 0},
        {"name": "a", "bytes": 2**60},
        {"name": "a", "bytes": 1, "sha256": "xyz"},
        {"name": "a", "bytes": 1, "sidecar": {"format": "compact"}},
        {"name": "a", "bytes": 1, "geometry": {"width": -1}},
    ],
)
def test_announcements_that_cannot_be(service: Any, body: dict[str, Any]) -> None:
    assert service.http.post("uploads", json=body).status_code == 422


def test_more_than_the_settings_allow_is_told_at_once(service: Any) -> None:
    answer = service.http.post("uploads", json={"name": "a", "bytes": 2**41})
    assert answer.status_code == 413
    assert "exceed the limit of" in answer.json()["detail"]


def test_more_than_the_disk_has_is_told_at_once(daemon: Any) -> None:
    one = daemon("--set", f"limit_upload_bytes={2**42}")
    answer = one.http.post("uploads", json={"name": "a", "bytes": 2**41})
    assert answer.status_code == 507
    assert "do not fit" in answer.json()["detail"]


def test_a_profile_and_a_calibration_come_with_an_upload(service: Service, tmp_path: Path) -> None:
    sensor = write_recording(tmp_path / "plain.dat")
    (tmp_path / "plain.json").unlink()
    plain = np.ones((sensor.height, sensor.width), np.float32)
    Calibration(plain, 0.25 * plain, plain < 0).write(tmp_path / "gains.npz")
    profile = ProfileModel(width=sensor.width, height=sensor.height, rate=12_500.0, fov=50.0, mosaic="BGGR")
    geometry = GeometryModel(rate=25_000.0)
    capture = service.client.upload(
        tmp_path / "plain.dat", profile=profile, geometry=geometry, calibration=tmp_path / "gains.npz"
    )
    assert capture.sensor is not None and capture.sensor.intrinsics is not None
    assert (capture.sensor.frame_rate_hz, capture.sensor.mosaic) == (25_000, "BGGR")  # what is stated wins
    assert capture.sensor.intrinsics.fx == pytest.approx(Intrinsics.from_fov(sensor.width, sensor.height, 50).fx)
    saved = service.client.save_recording(capture.id, tmp_path / "again.dat")
    assert json.loads(saved.with_suffix(".json").read_text())["calibration"] == "calibration.npz"
    (folder,) = Path(service.http.get("system").json()["data_folder"]).glob(f"captures/{capture.id}")
    assert np.array_equal(Calibration.read(folder / "calibration.npz").dark, 0.25 * plain)


def test_the_device_of_an_upload_gives_its_profile_and_calibration(service: Service, tmp_path: Path) -> None:
    sensor = write_recording(tmp_path / "plain.dat")
    (tmp_path / "plain.json").unlink()
    with pytest.raises(ApiError, match=r"has no profile|there is no device"):
        service.client.upload(tmp_path / "plain.dat", device="sim:")
    service.client.set_profile("sim:", ProfileModel(width=sensor.width, height=sensor.height, rate=15_000.0))
    try:
        capture = service.client.upload(tmp_path / "plain.dat", device="sim:")
    finally:
        service.http.delete("devices/sim%3A/profile")
    assert capture.sensor is not None and capture.sensor.frame_rate_hz == 15_000


def test_a_calibration_of_another_camera_is_refused(service: Service, tmp_path: Path) -> None:
    write_recording(tmp_path / "plain.dat")
    other = np.ones((8, 16), np.float32)
    Calibration(other, 0 * other, other < 0).write(tmp_path / "other.npz")
    (tmp_path / "none.npz").write_bytes(b"not a calibration")
    for name, words in (("other.npz", "calibration is of 16x8"), ("none.npz", "is not a calibration")):
        with pytest.raises(ApiError, match=words) as error:
            service.client.upload(tmp_path / "plain.dat", calibration=tmp_path / name)
        assert "uploads/" not in str(error.value)
    for upload in service.http.get("uploads").json()["items"]:
        assert service.http.delete(f"uploads/{upload['id']}").status_code == 204
