"""Recordings from elsewhere: in chunks, taken up where they broke off, checked in a worker."""

import hashlib
import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from spiked.client import ApiError, GeometryModel, IntrinsicsModel, ReconstructionOptions

from .conftest import write_recording

CHUNK = {"Content-Type": "application/octet-stream"}


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


def test_an_upload_becomes_a_capture_that_can_be_reconstructed(service: Any, recording: Path) -> None:
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
    job = service.client.start_reconstruction(capture.id, options=ReconstructionOptions(steps=5))
    assert service.client.wait_for_reconstruction(job.id, 120).state == "complete"


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
    assert patch(service, upload, service.http.get(f"uploads/{upload}").json()["offset_bytes"], b"").status_code == 200
    now = service.http.get(f"uploads/{upload}").json()["offset_bytes"]
    assert patch(service, upload, now, content[now:]).json()["offset_bytes"] == len(content)
    done = service.http.post(f"uploads/{upload}:complete")
    assert done.status_code == 201
    assert service.http.post(f"uploads/{upload}:complete").json()["id"] == done.json()["id"]
    assert patch(service, upload, len(content), b"").status_code == 409
    assert upload not in [one["id"] for one in service.http.get("uploads").json()["items"]]
    assert service.http.delete(f"uploads/{upload}").status_code == 204


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
    assert "may have" in answer.json()["detail"]


def test_more_than_the_disk_has_is_told_at_once(daemon: Any) -> None:
    one = daemon("--set", f"limit_upload_bytes={2**42}")
    answer = one.http.post("uploads", json={"name": "a", "bytes": 2**41})
    assert answer.status_code == 507
    assert "do not fit" in answer.json()["detail"]
