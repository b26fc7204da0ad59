"""A disk that is full is an answer that says so, and what was there stays."""

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from spiked_service.api.problems import install

from ...small_disk import fill, small_disk
from .conftest import reconstructed, running, write_recording


def app_that_meets(error: OSError) -> TestClient:
    app = FastAPI()
    install(app)

    @app.post("/scale")
    def write() -> None:
        raise error

    return TestClient(app, raise_server_exceptions=False)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_507(number: int) -> None:
    answer = app_that_meets(OSError(number, "full")).post("/scale")
    assert answer.status_code == 507 and "free disk space" in answer.json()["detail"]


def test_other_errors_of_the_system_are_unexpected() -> None:
    assert app_that_meets(OSError(errno.EIO, "broken")).post("/scale").status_code == 500


def test_a_daemon_on_a_full_disk_answers_and_works_again_with_room(tmp_path: Path, daemon_class: Any) -> None:
    with small_disk(tmp_path / "data", 24) as disk, running(tmp_path, daemon_class) as service:
        done = reconstructed(service)
        job = f"reconstructions/{service.client.wait_for_reconstruction(done.reconstruction_ids[0], 120).id}"
        others = fill(disk)
        before = sorted(disk.rglob("*"))
        for form in ("ply", "depth?views=2", "nexus?views=2"):
            answer = service.http.get(f"{job}/exports/{form}")
            assert answer.status_code == 507 and "free disk space" in answer.json()["detail"], answer.text
        made = set(disk.rglob("*")) - set(before) - {disk / "exports", disk / "exports.log"}
        assert not made
        assert service.http.patch(f"captures/{done.id}", json={"name": "new"}).status_code == 507
        assert service.http.post("reconstructions", json={"capture_id": done.id}).status_code == 507
        assert service.http.post("captures", json={"source": "sim:"}).status_code == 507
        for path in (f"captures/{done.id}", f"{job}/report", f"{job}/bundle"):
            assert service.http.get(path).status_code == 200
        assert service.http.delete(f"captures/{done.id}").status_code == 204, "what frees space is done"
        others.unlink()
        assert service.http.post(f"captures/{done.id}:restore").status_code == 200
        for number in range(5):  # left by workers that were killed
            shutil.copytree(disk / "profiles", disk / "exports" / f".export-{number}")
        assert service.http.get(f"{job}/exports/ply").status_code == 200
        (kept,) = (disk / "exports").iterdir()
        assert kept.name.startswith("0")
        fill(disk, left_bytes=kept.stat().st_size // 2)
        assert service.http.get(f"{job}/exports/ply?views=3").status_code == 200, "the kept one makes room"
        (other,) = (disk / "exports").iterdir()
        assert other.name != kept.name
        (disk / "others").unlink()
        assert service.http.patch(f"captures/{done.id}", json={"name": "new"}).status_code == 200


def test_what_a_full_disk_refuses_has_changed_nothing_and_is_done_later(tmp_path: Path, daemon_class: Any) -> None:
    write_recording(tmp_path / "garden.dat", frames=3000)
    content = (tmp_path / "garden.dat").read_bytes()
    upload = {
        "name": "garden",
        "bytes": len(content),
        "sidecar": json.loads((tmp_path / "garden.json").read_text()),
    }
    with small_disk(tmp_path / "data", 24) as disk, running(tmp_path, daemon_class) as service:
        http, done = service.http, reconstructed(service)
        before = service.client.wait_for_reconstruction(done.reconstruction_ids[0], 120)
        job = f"reconstructions/{before.id}"
        uploading = f"uploads/{http.post('uploads', json=upload).json()['id']}"

        def send(offset: int, end: int | None = None) -> int:
            headers = {"Content-Type": "application/octet-stream", "Upload-Offset": str(offset)}
            return int(http.patch(uploading, content=content[offset:end], headers=headers).status_code)

        assert send(0, 500_000) == 200
        fill(disk, left_bytes=200_000)
        assert send(500_000) == 507
        offset = http.get(uploading).json()["offset_bytes"]
        assert 500_000 <= offset < len(content), "what had room is kept"
        fill(disk)
        files = {path: path.stat().st_size for path in disk.rglob("*") if path.is_file() and path.name != "others"}

        def requests() -> dict[str, httpx.Response]:
            box = {"low": [-1.0, -1.0, -1.0], "high": [1.0, 1.0, 1.0]}
            return {
                "clean": http.post(f"{job}:clean", json={"version": before.version, "box": box}),
                "scale": http.put(f"{job}/scale", json={"revision": 0, "metres_per_unit": 2.0}),
                "profile": http.put("devices/sim%3A/profile", json={"model": "toy"}),
                "name": http.patch(job, json={"name": "desk"}),
                "tags": http.patch(f"captures/{done.id}", json={"tags": ["desk"]}),
                "localise": http.post(f"{job}:localise", json={"capture_id": done.id}),
                "restart": http.post(f"{job}:restart"),
                "upload": http.post("uploads", json={"name": "another", "bytes": 100}),
            }

        for what, answer in requests().items():
            assert answer.status_code == 507, f"{what}: {answer.status_code} {answer.text}"
            assert "free disk space" in answer.json()["what_to_do"]
        assert service.client.reconstruction(before.id) == before
        assert http.get("devices/sim%3A/profile").status_code == 404
        after = {path: path.stat().st_size for path in disk.rglob("*") if path.is_file() and path.name != "others"}
        changed = {path.name for path, _ in files.items() ^ after.items()} - {"catalogue.sqlite-wal"}
        copies = {name for name in changed if not name.removesuffix(".outdated").endswith((".json", ".upload"))}
        assert not copies, changed

        (disk / "others").unlink()
        for what, answer in requests().items():
            assert answer.status_code in (200, 201, 202), f"{what}: {answer.text}"
        assert send(offset) == 200
        capture = http.post(f"{uploading}:complete").json()["id"]
        assert service.client.wait_for_capture(capture, 60).verdict.grade == "good"
        assert http.get(f"captures/{capture}/recording").content == content
