"""Reports and bundles over HTTP: the page, the archive, their validators, and jobs without results."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from spiked.client import ApiError, CaptureOut
from spiked.scene import Scene
from spiked.trajectory import Trajectory

from .conftest import FRAMES, SIZE, Service


def test_the_report_is_a_page_that_cannot_fetch_anything(service: Service, job: str) -> None:
    answer = service.http.get(f"reconstructions/{job}/report")
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.headers["content-security-policy"].startswith("default-src 'none'; img-src data:")
    row = service.client.reconstruction(job)
    assert answer.headers["content-disposition"] == f'inline; filename="{job}-{row.version:06d}.html"'
    assert f'<data value="{row.poses}">' in answer.text and f'<data value="{row.splats}">' in answer.text
    assert "by hand" in answer.text and ">processor<" in answer.text
    assert answer.text.count("data:image/webp;base64,") == 8
    assert service.client.report(job) == answer.text
    again = service.http.get(f"reconstructions/{job}/report", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304


def test_a_bundle_has_the_version(service: Service, done: CaptureOut, job: str) -> None:
    answer = service.http.get(f"reconstructions/{job}/bundle")
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"].startswith(f'attachment; filename="{job}-')
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        files = {name.split("/", 1)[1]: archive.read(name) for name in archive.namelist()}
    assert {name.split("/")[0] for name in zipfile.ZipFile(io.BytesIO(answer.content)).namelist()} == {"by_hand"}
    assert files["scene.ply"] == service.client.scene(job)
    assert files["trajectory.tum"] == service.client.trajectory_file(job)
    report = json.loads(files["report.json"])
    row = service.client.reconstruction(job)
    assert (report["splats"], report["poses"], report["frames"]) == (row.splats, row.poses, FRAMES)
    assert report["sensor"] == {"width": SIZE[0], "height": SIZE[1], "frame_rate_hz": 20_000}
    assert report["job"]["capture"] == done.id and report["options"]["steps"] == 20
    assert len(report["views"]) > 10 and report["views"][0]["rate"] > 0
    assert {"report.html", "README.txt", "recording.json", "transforms.json", "colmap/images.txt"} <= files.keys()
    assert "recording.dat" not in files and "pictures/00-observed.png" in files


def test_a_bundle_with_its_recording_is_saved(service: Service, done: CaptureOut, job: str, tmp_path: Path) -> None:
    path = service.client.save_bundle(job, tmp_path / "all.zip", recording=True)
    with zipfile.ZipFile(path) as archive:
        recording = archive.read("by_hand/recording.dat")
        (tmp_path / "scene.ply").write_bytes(archive.read("by_hand/scene.ply"))
        (tmp_path / "path.tum").write_bytes(archive.read("by_hand/trajectory.tum"))
    assert recording == service.http.get(f"captures/{done.id}/recording").content
    assert (
        len(Scene.read_ply(tmp_path / "scene.ply"))
        and np.isfinite(Trajectory.read_tum(tmp_path / "path.tum").centres).all()
    )
    assert [file.name for file in tmp_path.iterdir() if file.name.endswith(".part")] == []


def test_validators_tell_bundles_apart(service: Service, job: str) -> None:
    def tag(path: str) -> str:
        return service.http.head(f"reconstructions/{job}/{path}").headers["etag"]

    assert len({tag("report"), tag("bundle"), tag("bundle?recording=true")}) == 3
    same = service.http.get(f"reconstructions/{job}/bundle", headers={"If-None-Match": tag("bundle")})
    assert same.status_code == 304


def test_jobs_without_results_are_told(service: Service, job: str) -> None:
    started = service.client.start_capture("sim:?width=64&height=64", frames=64, reconstruct=False)
    capture = service.client.wait_for_capture(started.id)
    row = service.client.start_reconstruction(capture.id)
    over = service.client.wait_for_reconstruction(row.id, 120)
    for path in ("report", "bundle"):
        answer = service.http.get(f"reconstructions/{over.id}/{path}")
        assert answer.status_code == 404 and "has published nothing" in answer.json()["detail"]
    with pytest.raises(ApiError, match="version 99"):
        service.client.report(job, version=99)


def test_a_recording_that_cannot_be_read_is_not_left_out_silently(service: Service, done: CaptureOut, job: str) -> None:
    command = service.daemon.process.args
    path = Path(command[command.index("--data") + 1], "captures", done.id, "recording.dat")
    away = path.rename(path.with_suffix(".away"))
    try:
        answer = service.http.get(f"reconstructions/{job}/bundle?recording=true")
    finally:
        away.rename(path)
    assert answer.is_client_error and "cannot be read; leave it out" in answer.json()["detail"]
