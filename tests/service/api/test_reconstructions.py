"""Reconstructions over HTTP: jobs, trajectories, scenes, views."""

import io
import json
import re
import time
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from spiked.client import ApiError, CaptureOut, ReconstructionOptions
from spiked.pose import quaternion, rotation_of
from spiked.scene import Scene
from spiked.scene_changes import SceneChanges, SceneMirror
from spiked.spz import decode
from spiked.trajectory import Trajectory


def decoded(content: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image)


def view(service: Any, job: str, body: dict[str, Any], kind: str = "png") -> Any:
    answer = service.http.post(f"reconstructions/{job}/views", json=body, params={"format": kind})
    assert answer.status_code == 200, answer.text
    return answer


def exr(content: bytes, tmp_path: Any) -> np.ndarray:
    (tmp_path / "view.exr").write_bytes(content)
    return np.asarray(oiio.ImageBuf(str(tmp_path / "view.exr")).get_pixels(oiio.FLOAT))


def test_five_formats_hold_the_same_poses(service: Any, job: str, tmp_path: Any) -> None:
    client = service.client
    listed = client.trajectory(job)
    (tmp_path / "t.tum").write_bytes(client.trajectory_file(job, "tum"))
    tum = Trajectory.read_tum(tmp_path / "t.tum")
    assert len(tum) == len(listed.frames) > 100
    np.testing.assert_allclose(listed.positions, tum.centres, atol=1e-8)
    np.testing.assert_allclose(np.array(listed.frames) + 0.5, tum.times_s * 20_000, atol=1e-3)
    assert set(listed.states) <= {"boot", "track", "degraded"}
    kitti = np.loadtxt(io.BytesIO(client.trajectory_file(job, "kitti"))).reshape(-1, 3, 4)
    np.testing.assert_allclose(kitti, tum.matrices()[:, :3], atol=1e-7)
    frames = json.loads(client.trajectory_file(job, "nerfstudio"))["frames"]
    np.testing.assert_allclose([np.array(f["transform_matrix"])[:3, 3] for f in frames], tum.centres, atol=1e-7)
    with zipfile.ZipFile(io.BytesIO(client.trajectory_file(job, "colmap"))) as archive:
        camera = archive.read("cameras.txt").decode().splitlines()[1].split()
        assert camera[:4] == ["1", "PINHOLE", "160", "100"]
        lines = [line for line in archive.read("images.txt").decode().splitlines()[1:] if line]
    pose = np.array([float(word) for word in lines[0].split()[1:8]])
    np.testing.assert_allclose(-rotation_of(pose[:4]).T @ pose[4:], tum.centres[0], atol=1e-6)


def test_a_part_of_a_trajectory(service: Any, job: str) -> None:
    whole = service.client.trajectory(job)
    begin, end = whole.times_s[50], whole.times_s[100]
    part = service.client.trajectory(job, from_s=begin, to_s=end, step=10)
    assert part.frames == whole.frames[50:100:10]
    nothing = service.http.get(f"reconstructions/{job}/trajectory", params={"from_s": 1000})
    assert nothing.status_code == 404
    assert "there are poses from" in nothing.json()["detail"]


def test_versions_have_validators(service: Any, job: str) -> None:
    versions = service.client.versions(job)
    newest = service.client.reconstruction(job).version
    assert versions[-1].version == newest
    for kind in ("scene", "scene/changes", "trajectory"):
        answer = service.http.get(f"reconstructions/{job}/{kind}")
        assert answer.headers["x-scene-version"] == str(newest)
        known = {"If-None-Match": answer.headers["etag"]}
        assert service.http.get(f"reconstructions/{job}/{kind}", headers=known).status_code == 304
        other = service.http.get(f"reconstructions/{job}/{kind}", params={"version": newest + 7})
        assert other.status_code == 404


def test_spz_and_a_sample_are_the_scene(service: Any, job: str, tmp_path: Any) -> None:
    (tmp_path / "s.ply").write_bytes(service.client.scene(job))
    scene = Scene.read_ply(tmp_path / "s.ply")
    white = float(service.http.get(f"reconstructions/{job}/scene").headers["x-white"])
    packed = decode(service.client.scene(job, "spz"), white)
    assert len(packed) == len(scene) > 100
    np.testing.assert_allclose(packed.means, scene.means, atol=1e-3 * float(np.abs(scene.means).max()))
    (tmp_path / "s.ply").write_bytes(service.client.scene(job, "ply", max_splats=100))
    np.testing.assert_array_equal(Scene.read_ply(tmp_path / "s.ply").means, scene.sample(100).means)
    part = service.http.get(f"reconstructions/{job}/scene", headers={"Range": "bytes=0-2"})
    assert (part.status_code, part.content) == (206, b"ply")


def test_versions_tell_the_optics_that_they_were_made_with(service: Any, done: CaptureOut, job: str) -> None:
    """Of a camera that was calibrated by the reconstruction these are not those of the sensor."""
    sensor = service.http.get(f"captures/{done.id}").json()["sensor"]
    assert service.client.versions(job)[-1].intrinsics.fx == pytest.approx(sensor["intrinsics"]["fx"])
    (index,) = Path(service.http.get("system").json()["data_folder"]).glob(f"reconstructions/{job}/**/published.json")
    before = index.read_bytes()
    content = json.loads(before)
    content["versions"][-1] |= {"intrinsics": [123.0, 124.0, 80.0, 50.0], "distortion": {"model": "opencv", "k1": -0.1}}
    index.write_text(json.dumps(content))
    found = service.http.get(f"reconstructions/{job}/versions").json()["items"][-1]["intrinsics"]
    assert (found["fx"], found["distortion"]["k1"]) == (123.0, -0.1)
    preview = f"captures/{done.id}/preview?frame=100&undistorted=true"
    plain, straight = (service.http.get(preview + more).content for more in ("", f"&optics_of={job}"))
    assert (decoded(plain) != decoded(straight)).any(), "the lens is the one that the reconstruction found"
    first, last = (
        service.http.get(f"{preview}&optics_of={job}&optics_version={one['version']}").content
        for one in (content["versions"][0], content["versions"][-1])
    )
    np.testing.assert_array_equal(decoded(first), decoded(plain), "the first version has its own lens")
    np.testing.assert_array_equal(decoded(last), decoded(straight))
    assert service.http.get(f"{preview}&optics_of={job}&optics_version=999").status_code == 404
    content["versions"][-1] |= {"intrinsics": None, "distortion": None}
    index.write_text(json.dumps(content))
    assert service.http.get(f"reconstructions/{job}/versions").json()["items"][-1]["intrinsics"] is None
    index.write_bytes(before)


def test_a_picture_is_not_undistorted_by_the_optics_of_another_capture(service: Any, job: str) -> None:
    other = service.capture(name="no reconstruction", reconstruct=False)
    asked = {"frame": 0, "undistorted": True, "optics_of": job}
    refused = service.http.get(f"captures/{other.id}/preview", params=asked)
    assert (refused.status_code, "not of this one" in refused.text) == (422, True), refused.text


def test_changes_since_a_state(service: Any, job: str, tmp_path: Any) -> None:
    mirror = SceneMirror()
    assert service.client.update_scene(job, mirror).whole
    versions = service.client.versions(job)
    (tmp_path / "s.ply").write_bytes(service.client.scene(job))
    scene = Scene.read_ply(tmp_path / "s.ply")
    shown = mirror.scene(scene.white)
    assert len(shown) == len(scene) == versions[-1].splats
    order = np.lexsort(scene.means.T), np.lexsort(shown.means.T)
    np.testing.assert_array_equal(scene.means[order[0]], shown.means[order[1]])
    nothing = service.client.update_scene(job, mirror)
    assert (nothing.whole, len(nothing), nothing.state) == (False, 0, mirror.state)
    # Of other slots, of another level, and of a version yet to come: everything.
    began, version, _ = (int(part) for part in mirror.state.split("-"))
    url = f"reconstructions/{job}/scene/changes"
    for since in (f"{began + 1}-{version}-2", f"{began}-{version}-1", f"{began}-{version + 9}-2", "0-0-0"):
        changes = SceneChanges.read(service.http.get(url, params={"since": since}).content)
        assert changes.whole and len(changes) == len(scene)
    assert 0 < len(SceneChanges.read(service.http.get(url, params={"level": 1}).content)) < len(scene) / 3
    old = SceneChanges.read(
        service.http.get(url, params={"version": versions[0].version, "since": mirror.state}).content
    )
    assert old.whole and len(old) == versions[0].splats
    for wrong in ({"since": "1"}, {"since": "1-2-3-4"}, {"level": 3}, {"level": -1}):
        assert service.http.get(url, params=wrong).status_code == 422


@pytest.mark.parametrize(("kind", "magic"), [("png", b"\x89PNG"), ("webp", b"RIFF"), ("jpeg", b"\xff\xd8\xff")])
def test_a_view_in_formats_for_people(service: Any, job: str, kind: str, magic: bytes) -> None:
    answer = view(service, job, {"camera": {"frame": 300}}, kind)
    assert answer.headers["content-type"] == f"image/{kind}"
    assert answer.content.startswith(magic)
    assert decoded(answer.content).shape[:2] == (100, 160)
    by_header = service.http.post(
        f"reconstructions/{job}/views", json={"camera": {"frame": 300}}, headers={"Accept": f"image/{kind}"}
    )
    assert by_header.content == answer.content


def test_the_three_ways_to_say_a_pose_agree(service: Any, job: str) -> None:
    trajectory = service.client.trajectory(job)
    row = 200
    position, turn = trajectory.positions[row], trajectory.quaternions_wxyz[row]
    c2w = np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = rotation_of(np.array(turn)), position
    np.testing.assert_allclose(np.abs(quaternion(c2w[:3, :3]) @ np.array(turn)), 1, atol=1e-6)
    pictures = [
        decoded(view(service, job, {"camera": camera}).content).astype(int)
        for camera in (
            {"frame": trajectory.frames[row]},
            {"position": position, "quaternion_wxyz": turn},
            {"c2w": c2w.tolist()},
        )
    ]
    for other in pictures[1:]:
        assert np.abs(other - pictures[0]).max() <= 1


def test_depth_alpha_and_background(service: Any, job: str, tmp_path: Any) -> None:
    away = {"c2w": [[1, 0, 0, 1e6], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    here = {"frame": 300}
    alpha = exr(view(service, job, {"camera": here, "output": "alpha"}, "exr").content, tmp_path)
    assert 0.5 < alpha.mean() <= 1
    depth = exr(view(service, job, {"camera": here, "output": "depth"}, "exr").content, tmp_path)
    assert 0.1 < np.median(depth) < 100
    seen = exr(view(service, job, {"camera": here}, "exr").content, tmp_path)
    behind = exr(view(service, job, {"camera": here, "background": [1, 1, 1]}, "exr").content, tmp_path)
    white = service.client.reconstruction(job).white
    np.testing.assert_allclose(behind, seen + (1 - alpha) * white, atol=1e-5)
    red = decoded(view(service, job, {"camera": away, "background": [1, 0, 0]}).content)
    assert red[0, 0].tolist() == [0, 0, 255]  # OpenCV reads blue first


def test_a_pixel_as_numbers_is_that_of_the_pictures(service: Any, job: str, tmp_path: Any) -> None:
    pictures = {
        kind: exr(view(service, job, {"camera": {"frame": 300}, "output": kind}, "exr").content, tmp_path)
        for kind in ("color", "depth", "alpha")
    }
    trajectory = service.client.trajectory(job)
    centre = trajectory.positions[trajectory.frames.index(300)]
    turn = rotation_of(np.array(trajectory.quaternions_wxyz[trajectory.frames.index(300)]))
    k = service.client.capture(service.client.reconstruction(job).capture_id).sensor.intrinsics

    def at(kind: str, x: int, y: int) -> float:
        return float(np.ravel(pictures[kind][y, x])[0])

    solid = 0
    for x, y in ((0, 0), (80, 50), (31, 72), (159, 99)):
        point = service.http.get(f"reconstructions/{job}/point", params={"x": x, "y": y, "frame": 300}).json()
        assert point["opacity"] == pytest.approx(at("alpha", x, y), rel=1e-6)
        assert point["rate"] == pytest.approx([at("color", x, y)], rel=1e-6)
        assert (point["depth"] is None) == (point["position"] is None) == (point["opacity"] < 0.5)
        assert (point["frame"], point["depth_m"]) == (300, None)
        if point["depth"] is not None:
            solid += 1
            assert point["depth"] == pytest.approx(at("depth", x, y), rel=1e-6)
            seen = turn.T @ (np.array(point["position"]) - centre)
            pixel = k.fx * seen[0] / seen[2] + k.cx, k.fy * seen[1] / seen[2] + k.cy
            assert pixel == pytest.approx((x + 0.5, y + 0.5), abs=1e-6) and seen[2] == pytest.approx(point["depth"])
    assert solid >= 2
    newest = service.http.get(f"reconstructions/{job}/point?x=80&y=50").json()
    assert newest["frame"] == trajectory.frames[-1]
    for wrong, status in (("x=160&y=0", 404), ("x=0&y=100", 404), ("x=0", 422), ("x=0&y=0&frame=999999", 404)):
        assert service.http.get(f"reconstructions/{job}/point?{wrong}").status_code == status, wrong


def test_another_size_shows_the_same(service: Any, job: str) -> None:
    small = decoded(view(service, job, {"camera": {"frame": 300}}).content)
    large = decoded(view(service, job, {"camera": {"frame": 300}, "width": 320, "height": 200}).content)
    shrunk = cv2.resize(large, (160, 100), interpolation=cv2.INTER_AREA)
    # A pixel blurs the splats that are smaller than itself, so the two differ by about 6 of 255 in a map of 20 steps.
    assert abs(shrunk.mean() - small.mean()) < 10
    assert np.corrcoef(shrunk.ravel(), small.ravel())[0, 1] > 0.95


def test_several_views_are_a_zip(service: Any, job: str) -> None:
    for body, count in (
        ({"cameras": [{"frame": 100}, {"frame": 200}, {"frame": 300}]}, 3),
        ({"path": {"count": 5}, "width": 80, "height": 50}, 5),
        ({"path": {"count": 2, "from_s": 0.005, "to_s": 0.01}}, 2),
    ):
        answer = view(service, job, body, "jpeg")
        assert answer.headers["content-type"] == "application/zip"
        with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
            about = json.loads(archive.read("views.json"))
            assert [entry["file"] for entry in about["views"]] == [f"{i:03d}.jpeg" for i in range(count)]
            pictures = [decoded(archive.read(entry["file"])) for entry in about["views"]]
        assert not np.array_equal(pictures[0], pictures[1])


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"camera": {"frame": 1}, "path": {"count": 1}},
        {"camera": {}},
        {"camera": {"position": [0, 0, 0]}},
        {"camera": {"position": [0, 0, 0], "quaternion_wxyz": [0, 0, 0, 0]}},
        {"camera": {"c2w": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}},
        {"camera": {"c2w": [[1e300, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}},
        {"camera": {"frame": 100}, "width": 10},
        {"camera": {"frame": 100}, "width": 5000, "height": 10},
        {"path": {"count": 100}, "width": 4000, "height": 4000},
        {"camera": {"frame": 100}, "white": 0},
        {"camera": {"frame": 100}, "background": [-1, 0, 0]},
    ],
)
def test_views_that_cannot_be(service: Any, job: str, body: dict[str, Any]) -> None:
    answer = service.http.post(f"reconstructions/{job}/views", json=body)
    assert answer.status_code == 422, answer.text
    assert answer.headers["content-type"] == "application/problem+json"


def test_not_a_number_is_refused(service: Any, job: str) -> None:
    body = b'{"camera": {"position": [NaN, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}}'
    answer = service.http.post(
        f"reconstructions/{job}/views", content=body, headers={"Content-Type": "application/json"}
    )
    assert answer.status_code == 422


def test_a_timeline_and_a_log(service: Any, job: str) -> None:
    timeline = service.client.timeline(job)
    lengths = {
        len(values) for name, values in timeline.model_dump().items() if name not in ("gaps", "closures", "work")
    }
    assert lengths == {len(timeline.frame)} and len(timeline.frame) > 5
    work = timeline.work
    assert len(work.work_s) == len(work.loss) == len(work.psnr_db) == len(work.splats) >= 1
    assert work.work_s == sorted(work.work_s) and timeline.work_s == sorted(timeline.work_s)
    assert work.work_s[-1] > timeline.work_s[-1], "the refinement follows the last view"
    coarse = service.client.timeline(job, points=3)
    assert len(coarse.work.work_s) <= 3 and coarse.work.work_s[-1] == work.work_s[-1]
    assert len(coarse.frame) <= 3 and coarse.frame[-1] == timeline.frame[-1]
    part = service.client.timeline(job, from_s=timeline.time_s[2], to_s=timeline.time_s[4])
    assert part.frame == timeline.frame[2:4]
    assert timeline.frame == sorted(timeline.frame)
    assert service.http.get(f"reconstructions/{job}/log").status_code == 200


def test_what_is_shown_of_captures_is_listed_at_once(service: Any, done: CaptureOut, job: str) -> None:
    asked = {"shown_of": [done.id, "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"]}
    found = service.http.get("reconstructions", params=asked).json()["items"]
    newest = max(one.id for one in service.client.reconstructions(capture_id=done.id) if one.version)
    assert [one["id"] for one in found] == [newest]
    assert service.http.get("reconstructions", params={**asked, "state": "failed"}).status_code == 422
    capture = service.client.capture(done.id)
    assert capture.reconstruction_count == len(capture.reconstruction_ids) > 0


def test_a_recording_is_reconstructed_again_with_other_options(service: Any, done: CaptureOut) -> None:
    client = service.client
    started = client.start_reconstruction(done.id, options=ReconstructionOptions(steps=5, seed=3), priority=2)
    assert (started.live, started.priority, started.options.seed) == (False, 2, 3)
    assert started.state in ("queued", "running")
    over = client.wait_for_reconstruction(started.id, 120)
    assert over.state == "complete", over.reason
    assert over.frames == done.recording.frames
    assert over.progress == 1
    assert (over.tracking_state == "track") == (over.reason == ""), "one that ends in doubt says why"
    assert started.id in [one.id for one in client.reconstructions(capture_id=done.id)]
    with pytest.raises(ApiError):
        client.start_reconstruction("01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10")
    client.remove_reconstruction(started.id)
    with pytest.raises(ApiError) as gone:
        client.reconstruction(started.id)
    assert gone.value.status == 404


def test_parts_of_the_paper_s_method_are_options(service: Any, done: CaptureOut) -> None:
    options = {
        "method": "nope-sgs",
        "initialisation": "tracks",
        "loss": "charge",
        "pose_step": "alignment",
        "steps": 30,
    }
    answer = service.http.post("reconstructions", json={"capture_id": done.id, "options": options})
    assert answer.status_code == 202, answer.text
    over = service.client.wait_for_reconstruction(answer.json()["id"], 120)
    assert over.state == "complete", over.reason
    with zipfile.ZipFile(io.BytesIO(service.http.get(f"reconstructions/{over.id}/bundle").content)) as bundle:
        report = json.loads(bundle.read(next(name for name in bundle.namelist() if name.endswith("/report.json"))))
    assert {name: report["options"][name] for name in options} == options
    wrong = service.http.post("reconstructions", json={"capture_id": done.id, "options": {"loss": "photons"}})
    assert wrong.status_code == 422 and "accumulation" in wrong.json()["detail"]
    service.client.remove_reconstruction(over.id)


def test_cancel_and_restart(service: Any, done: CaptureOut) -> None:
    client = service.client
    started = client.start_reconstruction(done.id, options=ReconstructionOptions(steps=100_000))
    deadline = time.monotonic() + 60
    while client.reconstruction(started.id).state == "queued":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    client.cancel_reconstruction(started.id)
    cancelled = client.wait_for_reconstruction(started.id, 60)
    assert (cancelled.state, cancelled.reason) == ("cancelled", "")
    nothing = service.http.get(f"reconstructions/{started.id}/trajectory", params={"version": cancelled.version + 1})
    assert nothing.json()["type"].endswith(":nothing-there"), "who waits for it waits for ever"
    assert "is cancelled and has" in nothing.json()["detail"]
    client.restart_reconstruction(started.id, ReconstructionOptions(steps=5))
    assert client.wait_for_reconstruction(started.id, 120).state == "complete"
    client.remove_reconstruction(started.id)


def test_options_out_of_range_are_refused(service: Any, done: CaptureOut) -> None:
    for options in ({"steps": -1}, {"sttps": 1}, {"threads": 0}, {"seed": "x"}):
        answer = service.http.post("reconstructions", json={"capture_id": done.id, "options": options})
        assert answer.status_code == 422
        assert next(iter(options)) in answer.json()["detail"]


@pytest.mark.parametrize("what", ["scene?format=spz", "scene?max_splats=5", "scene/changes?level=1", "log"])
def test_what_is_no_file_comes_in_ranges_too(service: Any, job: str, what: str) -> None:
    url = f"reconstructions/{job}/{what}"
    whole = service.http.get(url).content
    size = len(whole)
    for asked, part in {"bytes=1-3": whole[1:4], f"bytes=2-{size + 9}": whole[2:], "bytes=-4": whole[-4:]}.items():
        answer = service.http.get(url, headers={"Range": asked})
        assert (answer.status_code, answer.content) == (206, part)
    outside = service.http.get(url, headers={"Range": f"bytes={size}-"})
    assert (outside.status_code, outside.headers["content-range"]) == (416, f"bytes */{size}")


def test_head_wherever_get_is(service: Any, done: CaptureOut, job: str) -> None:
    """The same status and headers, no body; ranges are for GET alone."""
    described = service.http.get(f"{service.daemon.address}openapi.json").json()
    known = {"{capture_id}": done.id, "{reconstruction_id}": job, "{device_id}": "sim:", "{upload_id}": "none"}
    known |= {"{group_id}": "none", "{format}": "spz"}
    paths = [path for path, operations in described["paths"].items() if "get" in operations]
    assert len(paths) > 25
    for path in [*paths, "/api/v1/events", "/", "/docs/", "/openapi.json", "/nowhere"]:
        filled = re.sub(r"\{\w+\}", lambda placeholder: known[placeholder[0]], path)
        url = service.daemon.address.rstrip("/") + filled
        head = service.http.head(url, headers={"Range": "bytes=0-1"})
        with service.http.stream("GET", url) as got:
            assert head.status_code == got.status_code, path
            assert head.headers.get("content-type") == got.headers.get("content-type")
            assert head.headers.get("etag") == got.headers.get("etag")
        assert head.content == b""
    refused = service.http.head(f"captures/{done.id}:stop")
    assert refused.status_code == 405 and refused.headers["allow"] == "POST"
    assert service.http.delete("captures").headers["allow"] == "GET, HEAD, POST"
    assert service.http.get("system").json()["event_clients"] == 0
