"""A disk that is full is an answer that says so, and what was there stays."""

import errno
import shutil
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from spiked_service.api.problems import install

from ...small_disk import fill, small_disk
from .conftest import reconstructed, running


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
