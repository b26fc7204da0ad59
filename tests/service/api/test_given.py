"""What a new reconstruction is given: poses, calibration, optics, mosaic, a time budget, the size of its map."""

from typing import Any

import numpy as np
import pytest

from spiked.calibration import Calibration
from spiked.client import CaptureOut, ReconstructionOut
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory

SIZE = (160, 100)
DEVICE = "sim:?width=160&height=100"


def again(service: Any, capture_id: str, **body: Any) -> ReconstructionOut:
    """A reconstruction of the capture with these fields of the request, when it is over."""
    options = {"steps": 20} | body.pop("options", {})
    answer = service.http.post("reconstructions", json={"capture_id": capture_id, "options": options, **body})
    assert answer.status_code == 202, answer.text
    over = service.client.wait_for_reconstruction(answer.json()["id"], 120)
    assert isinstance(over, ReconstructionOut)
    assert over.state == "complete", over.reason
    return over


def path_of(service: Any, job: str, tmp_path: Any) -> Trajectory:
    (tmp_path / "path.tum").write_bytes(service.client.trajectory_file(job, "tum"))
    return Trajectory.read_tum(tmp_path / "path.tum")


def test_given_poses_are_the_path(service: Any, done: CaptureOut, job: str, tmp_path: Any) -> None:
    client = service.client
    path = path_of(service, job, tmp_path)
    turned = Trajectory(path.times_s, path.rotations, 3.0 * path.centres + [5.0, 0.0, 0.0])
    over = again(service, done.id, poses=turned.tum())
    assert over.poses_from == "file"
    found = path_of(service, over.id, tmp_path)
    at = found.nearest(turned.times_s, 1e-6)
    kept = at >= 0
    assert kept.sum() > 0.9 * len(turned)
    np.testing.assert_allclose(found.centres[at[kept]], turned.centres[kept], atol=2e-3)

    copied = again(service, done.id, poses_of=over.id)
    assert copied.poses_from == over.id
    client.remove_reconstruction(over.id)
    client.restart_reconstruction(copied.id, copied.options)
    assert client.wait_for_reconstruction(copied.id, 120).poses_from == over.id, "poses of one that is gone are kept"
    np.testing.assert_allclose(path_of(service, copied.id, tmp_path).centres, found.centres, atol=2e-3)
    client.remove_reconstruction(copied.id)


@pytest.mark.parametrize(
    ("body", "status", "told"),
    [
        ({"poses": "not a pose\n"}, 422, "the poses, line 1"),
        ({"poses": "0 0 0 0 0 0 0 1\n"}, 422, "at least 2"),
        ({"poses": "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "poses_of": "x"}, 422, "give one of them"),
        ({"poses": "0 0 0 0 0 0 0 1\n0 1 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"}, 422, "of the time 0.0 s"),
        ({"poses": "1.7e9 0 0 0 0 0 0 1\n1.8e9 1 0 0 0 0 0 1\n"}, 422, "seconds since its first frame"),
        ({"poses_of": "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"}, 404, "no reconstruction"),
        ({"calibration_of": "usb7"}, 404, "no device usb7 with a calibration"),
        ({"options": {"fov": 60, "intrinsics": {"fx": 80, "fy": 80, "cx": 48, "cy": 32}}}, 422, "give one of them"),
    ],
)
def test_what_cannot_be_used_is_refused(
    service: Any, done: CaptureOut, body: dict[str, Any], status: int, told: str
) -> None:
    before = service.http.get("reconstructions").json()["items"]
    answer = service.http.post("reconstructions", json={"capture_id": done.id, **body})
    assert answer.status_code == status
    assert told in answer.json()["detail"]
    assert len(service.http.get("reconstructions").json()["items"]) == len(before)


def test_poses_of_another_capture_are_refused(service: Any, done: CaptureOut, job: str) -> None:
    other = service.capture(reconstruct=False)
    answer = service.http.post("reconstructions", json={"capture_id": other.id, "poses_of": job})
    assert answer.status_code == 422 and "another capture" in answer.json()["detail"]


def test_optics_and_size_of_the_map_are_options(service: Any, done: CaptureOut, job: str) -> None:
    over = again(service, done.id, options={"fov": 40, "most_splats": 1000})
    (version,) = service.http.get(f"reconstructions/{over.id}/trajectory").headers["x-scene-version"].split()
    assert int(version) == over.version
    exported = service.http.get(f"reconstructions/{over.id}/trajectory", params={"format": "nerfstudio"}).json()
    assert exported["fl_x"] == pytest.approx(Intrinsics.from_fov(*SIZE, 40).fx)
    assert over.splats <= 1000 < service.client.reconstruction(job).splats
    service.client.remove_reconstruction(over.id)


def test_a_time_budget_ends_the_work(service: Any, done: CaptureOut) -> None:
    over = again(service, done.id, options={"steps": 200_000, "seconds": 8})  # without it, an hour
    assert over.frames == done.recording.frames and over.poses > 0
    service.client.remove_reconstruction(over.id)
    answer = service.http.post(
        "reconstructions", json={"capture_id": done.id, "options": {"steps": 10, "seconds": 0.001}}
    )
    short = service.client.wait_for_reconstruction(answer.json()["id"], 60)
    assert any("the time was over after 64 frames" in text for text in short.warnings)
    service.client.remove_reconstruction(short.id)


def test_the_mosaic_and_the_orientation_are_stated_or_detected(service: Any, tmp_path: Any) -> None:
    capture = service.client.start_capture(f"{DEVICE}&mosaic=GRBG&fov=60", frames=512, reconstruct=False)
    service.client.wait_for_capture(capture.id, 60)
    grey = again(service, capture.id, options={"mosaic": "RGGB"})
    assert any("mosaic" in text for text in grey.warnings), "the pixels contradict what is stated"
    found = again(service, capture.id, options={"mosaic": "auto"})
    assert not any("contradict" in text or "will be wrong" in text for text in found.warnings), found.warnings
    heights = {
        flipped: path_of(service, again(service, capture.id, options={"flipped": flipped}).id, tmp_path).centres[:, 1]
        for flipped in (True, False)
    }
    both = min(map(len, heights.values()))
    assert np.corrcoef(heights[True][:both], heights[False][:both])[0, 1] < -0.9, "one sees it upside down"


def test_the_calibration_of_a_device_replaces_that_of_the_recording(
    service: Any, done: CaptureOut, tmp_path: Any
) -> None:
    device = service.http.get("devices").json()["items"][0]["id"]
    path = f"devices/{device.replace('/', '%2F')}/profile"
    dead = np.zeros((SIZE[1], SIZE[0]), bool)
    dead[10:90, 10:150] = True
    folder = service.daemon.data / "profiles"
    folder.mkdir(exist_ok=True)
    Calibration(np.ones(dead.shape, np.float32), np.zeros(dead.shape, np.float32), dead).write(folder / "mostly.npz")
    profile = {"calibration": "mostly.npz", "width": SIZE[0], "height": SIZE[1]}
    assert service.http.put(path, json=profile).status_code == 200
    answer = service.http.post(
        "reconstructions", json={"capture_id": done.id, "options": {"steps": 20}, "calibration_of": device}
    )
    assert answer.status_code == 202, answer.text
    assert answer.json()["calibration_from"] == device
    over = service.client.wait_for_reconstruction(answer.json()["id"], 120)
    service.http.delete(path)
    assert over.state == "failed", "with most pixels left out there is nothing to track"
