"""Results in the formats of other programs over HTTP."""

import io
import json
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import av
import httpx
import psutil
import pytest
from plyfile import PlyData
from waiting import until

from spiked.client import CaptureOut
from spiked.export import KINDS, find_kind

from .conftest import FRAMES, SIZE


def test_formats_are_listed_with_what_they_lose(service: Any) -> None:
    found = service.http.get("exports").json()["formats"]
    assert [one["name"] for one in found] == [kind.name for kind in KINDS]
    assert all(one["loses"] and one["readers"] and one["suffix"].startswith(".") for one in found)


def test_a_version_is_sent_in_a_format_and_in_ranges(service: Any, done: CaptureOut, job: str, tmp_path: Path) -> None:
    url = f"reconstructions/{job}/exports/ply"
    answer = service.http.get(url)
    assert answer.status_code == 200, answer.text
    version = answer.headers["x-scene-version"]
    assert f'filename="{job}-{int(version):06d}-ply.ply"' in answer.headers["content-disposition"]
    (tmp_path / "scene.ply").write_bytes(answer.content)
    assert len(PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data) > 0
    tag = answer.headers["etag"]
    assert service.http.get(url, headers={"if-none-match": tag}).status_code == 304
    part = service.http.get(url, headers={"range": "bytes=0-9"})
    assert part.status_code == 206 and part.content == answer.content[:10]
    assert service.http.get(f"captures/{done.id}/exports/ply").content == answer.content


def test_a_folder_is_sent_as_zip_with_the_pictures_of_the_recording(service: Any, done: CaptureOut, job: str) -> None:
    answer = service.http.get(f"reconstructions/{job}/exports/depth?views=2&expected_depth=true", timeout=120)
    assert answer.status_code == 200, answer.text
    names = zipfile.ZipFile(io.BytesIO(answer.content)).namelist()
    assert sum(name.endswith(".exr") for name in names) == 4 and any(name.endswith("depth.json") for name in names)
    bag = service.http.get(f"reconstructions/{job}/exports/nexus?views=2&expected_depth=true", timeout=120)
    assert bag.status_code == 200 and bag.content.startswith(b"\x89HDF")


def test_depth_of_chosen_frames(service: Any, job: str) -> None:
    poses = service.http.get(f"reconstructions/{job}/trajectory").json()
    frames = poses["frames"][3], poses["frames"][-4]
    url = f"reconstructions/{job}/exports/depth?expected_depth=true&frame="
    answer = service.http.get(f"{url}{frames[0]}&frame={frames[1]}", timeout=120)
    assert answer.status_code == 200, answer.text
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    (name,) = (name for name in archive.namelist() if name.endswith("depth.json"))
    times = [frame["time_s"] for frame in json.loads(archive.read(name))["frames"]]
    assert times == pytest.approx([poses["times_s"][3], poses["times_s"][-4]], abs=1e-9)
    assert "has no pose" in service.http.get(f"{url}99999999", timeout=120).json()["detail"]


@pytest.mark.parametrize("form", ["mesh-glb", "ply", "sog", "video"])
def test_files_are_sent_as_the_schema_says(service: Any, job: str, form: str) -> None:
    answer = service.http.get(f"reconstructions/{job}/exports/{form}?views=4&resolution=32&seconds=0.2", timeout=120)
    assert answer.status_code == 200, answer.text
    paths = service.http.get(f"{service.daemon.address}openapi.json").json()["paths"]
    told = paths["/api/v1/reconstructions/{reconstruction_id}/exports/{format}"]["get"]["responses"]["200"]["content"]
    assert answer.headers["content-type"] in told and answer.headers["content-type"] == find_kind(form).sent_as


def test_what_cannot_be_made_is_said(service: Any, done: CaptureOut, job: str) -> None:
    assert service.http.get(f"reconstructions/{job}/exports/ply?metric=true").status_code == 404
    assert service.http.get(f"reconstructions/{job}/exports/blend").status_code == 422
    assert service.http.get(f"reconstructions/{job}/exports/ply?version=999").status_code == 404
    for one in service.client.versions(job):  # the first may have been published before there were splats
        answer = service.http.get(f"reconstructions/{job}/exports/depth?views=2&version={one.version}", timeout=120)
        assert (answer.status_code, "has no splats" in answer.text) == ((200, False) if one.splats else (404, True))


def pictures_of(content: bytes) -> tuple[int, int, int, float]:
    """Width, height and number of the pictures of an MP4, and how many a second."""
    with av.open(io.BytesIO(content)) as file:
        shapes = [(frame.width, frame.height) for frame in file.decode(video=0)]
        assert len(set(shapes)) == 1
        return *shapes[0], len(shapes), float(file.streams.video[0].average_rate or 0)


def test_a_video_has_the_wanted_size_rate_and_path(service: Any, job: str) -> None:
    url = f"reconstructions/{job}/exports/video?seconds=0.5&width=120&height=90&fps=20"
    made = [service.http.get(f"{url}&along={along}", timeout=120) for along in ("smooth", "recorded")]
    assert [pictures_of(one.content) for one in made] == [(120, 90, 10, 20.0)] * 2
    assert made[0].content != made[1].content


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("seconds=1200&fps=240", "make the video shorter"),
        ("width=4096&height=4096&seconds=0.1", "more than 9,437,184 pixels"),
        ("width=1920&height=1080&seconds=1200", "make 17,361 at most, or smaller ones"),
    ],
)
def test_a_video_that_would_take_hours_is_refused(service: Any, job: str, asked: str, said: str) -> None:
    refused = service.http.get(f"reconstructions/{job}/exports/video?{asked}")
    assert refused.status_code == 422 and said in refused.json()["detail"], refused.text


def test_an_export_whose_client_has_gone_makes_way_for_others(service: Any, job: str) -> None:
    url = f"reconstructions/{job}/exports"
    with pytest.raises(httpx.ReadTimeout):
        service.http.get(f"{url}/video?width=1000&height=800&seconds=1000&fps=30", timeout=3)
    until(lambda: service.http.get(f"{url}/ply?views=7").status_code == 200, "another export is made", 15)
    kept = Path(service.http.get("system").json()["data_folder"]) / "exports"
    assert not [file for file in kept.iterdir() if file.name.startswith(".")], "what was begun is gone"


def test_an_export_whose_worker_is_killed_is_to_be_asked_for_again(service: Any, job: str) -> None:
    url = f"reconstructions/{job}/exports"
    with ThreadPoolExecutor(1) as client:
        answer = client.submit(service.http.get, f"{url}/video?width=1000&height=800&seconds=100&fps=30", timeout=60)
        kept = Path(service.http.get("system").json()["data_folder"]) / "exports"
        begun = until(lambda: list(kept.glob(".*")), "the export has begun", 30)
        until(lambda: [one for one in exporting() if not one.kill()], "its worker is killed", 30)
    assert answer.result().status_code == 503, answer.result().text
    assert "killed by signal 9" in answer.result().json()["detail"]
    assert not begun[0].exists(), "what was begun is gone"
    assert service.http.get(f"{url}/ply?views=6").status_code == 200


def exporting() -> list[psutil.Process]:
    """Workers that make exports."""
    everything = psutil.process_iter(["cmdline"])
    return [one for one in everything if {"spiked_service.workers", "export"} <= set(one.info["cmdline"] or [])]


def test_a_recording_is_sent_in_slow_motion(service: Any, done: CaptureOut) -> None:
    url = f"captures/{done.id}/recording/video"
    answer = service.http.get(f"{url}?slower=40&fps=25&window=8", timeout=120)
    assert answer.status_code == 200 and answer.headers["content-type"] == "video/mp4", answer.text
    assert pictures_of(answer.content) == (*SIZE, int(FRAMES / 20_000 * 40 * 25), 25.0)
    part = service.http.get(f"{url}?slower=400&fps=25&from_s=0.01&to_s=0.012&compensate=true", timeout=120)
    assert pictures_of(part.content)[2] == 20
    kept = service.http.get(f"{url}?slower=40&fps=25&window=8", headers={"range": "bytes=0-0"})
    assert kept.status_code == 206 and len(kept.content) == 1
    for wrong in ("slower=1e6", "from_s=99", "slower=0.01"):
        refused = service.http.get(f"{url}?{wrong}", timeout=120)
        assert refused.status_code == 422, refused.text
