"""The daemon as a user meets it: a process, HTTP, and the simulator's truth to judge by."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from spiked.evaluate import score_trajectory, score_views, similarity_of_trajectories
from spiked.sensor import Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.record import simulate
from spiked.trajectory import Trajectory

FRAMES = 1024
RATE_HZ = 20_000.0
END_S = 240.0


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated recording with its truth and two held-out views."""
    folder = tmp_path_factory.mktemp("e2e") / "room"
    simulate(SimulatedCamera(Sensor(320, 200, RATE_HZ), seed=3, parallax=0.3), folder, "room", FRAMES, views=2)
    return folder


def finished(http: Any, capture_id: str) -> dict[str, Any]:
    """The capture when it is over."""
    deadline = time.monotonic() + END_S
    while True:
        capture: dict[str, Any] = http.get(f"captures/{capture_id}").json()
        if capture["state"] in ("complete", "failed"):
            return capture
        assert time.monotonic() < deadline, f"the capture did not end: {capture}"
        time.sleep(0.2)


def test_a_recording_becomes_a_trajectory_and_novel_views(
    daemon: Callable[..., Any], room: Path, tmp_path: Path
) -> None:
    http = daemon().http
    request = {"source": f"replay:{room / 'room.dat'}", "options": {"steps": 300}}
    capture_id = http.post("captures", json=request).json()["id"]

    capture = finished(http, capture_id)
    assert (capture["state"], capture["reason"]) == ("complete", "")
    assert capture["counters"]["received"] == FRAMES
    assert sum(capture["counters"]["lost"].values()) == 0

    tum = tmp_path / "trajectory.tum"
    tum.write_text(http.get(f"captures/{capture_id}/trajectory", params={"format": "tum"}).text)
    estimate, truth = Trajectory.read_tum(tum), Trajectory.read_tum(room / "groundtruth.tum")
    score = score_trajectory(truth=truth, estimate=estimate, frame_rate_hz=RATE_HZ)
    assert score.coverage > 0.98
    assert score.errors is not None
    assert score.errors.ate_percent < 2
    assert score.errors.rpe_r_deg < 0.1

    listed = http.get(f"captures/{capture_id}/trajectory").json()
    np.testing.assert_allclose(listed["positions"], estimate.centres, atol=1e-8)

    def render(rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
        body = {"camera": {"c2w": np.vstack([np.column_stack([rotation, centre]), [0, 0, 0, 1]]).tolist()}}
        answer = http.post(f"captures/{capture_id}/views", json=body, headers={"Accept": "image/x-exr"})
        assert answer.status_code == 200, answer.text
        (tmp_path / "view.exr").write_bytes(answer.content)
        return np.asarray(oiio.ImageBuf(str(tmp_path / "view.exr")).get_pixels(oiio.FLOAT))[..., 0]

    held_out = json.loads((room / "views.json").read_text())
    to_estimate = similarity_of_trajectories(truth=truth, estimate=estimate, frame_rate_hz=RATE_HZ)
    poses = [np.array(view["c2w"]) for view in held_out["views"]]
    carried = [to_estimate.poses(pose[:3, :3], pose[:3, 3]) for pose in poses]
    pictures = [
        cv2.imread(str(room / view["file"]), cv2.IMREAD_GRAYSCALE) / np.float32(255) for view in held_out["views"]
    ]
    likeness = score_views(render, poses=carried, truths=pictures, length=to_estimate.scale * held_out["median_depth"])
    assert likeness.mean_psnr_db > 28

    scene = http.get(f"captures/{capture_id}/scene")
    assert scene.content.startswith(b"ply")
    known = {"If-None-Match": scene.headers["etag"]}
    assert http.get(f"captures/{capture_id}/scene", headers=known).status_code == 304
