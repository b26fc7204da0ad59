"""A scene cleaned over HTTP, and brought back."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from spiked.client import CaptureOut
from spiked.scene import Scene


def scene_of(service: Any, job: str, folder: Path) -> Scene:
    (folder / "scene.ply").write_bytes(service.client.scene(job))
    return Scene.read_ply(folder / "scene.ply")


def test_a_cleaned_scene_is_a_version_and_can_be_undone(
    service: Any, done: CaptureOut, job: str, tmp_path: Path
) -> None:
    http, url = service.http, f"reconstructions/{job}"
    before = http.get(url).json()
    scene = scene_of(service, job, tmp_path)
    low, high = np.percentile(scene.means, (5, 95), axis=0)
    body = {"version": before["version"], "box": {"low": low.tolist(), "high": high.tolist()}, "floaters": True}
    answer = http.post(f"{url}:clean", json=body)
    assert answer.status_code == 200, answer.text
    edited = answer.json()
    assert edited["version"] == before["version"] + 1 and edited["outside"] > 0
    assert edited["splats"] == len(scene_of(service, job, tmp_path)) < len(scene)
    assert http.get(url).json()["splats"] == edited["splats"]
    assert http.get(f"{url}/trajectory").json()["frames"]
    *_, earlier, newest = http.get(f"{url}/versions").json()["items"]
    assert (newest["version"], newest["cleaned_from"]) == (edited["version"], before["version"])
    assert earlier["cleaned_from"] is None
    assert http.post(f"{url}:clean", json=body).status_code == 409
    back = http.post(f"{url}:revert", json={"version": edited["version"], "to": before["version"]})
    assert back.status_code == 200, back.text
    assert (
        len(scene_of(service, job, tmp_path)) == len(scene) and http.get(url).json()["version"] == edited["version"] + 1
    )
    assert http.get(f"{url}/versions").json()["items"][-1]["cleaned_from"] is None


def test_what_is_outlined_in_a_view_is_removed(service: Any, done: CaptureOut, job: str, tmp_path: Path) -> None:
    http, url = service.http, f"reconstructions/{job}"
    before, scene = http.get(url).json(), scene_of(service, job, tmp_path)
    camera = {"position": [0.0, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    corners = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
    slopes = scene.means[:, :2] / scene.means[:, 2:]
    inside = (np.abs(slopes) < 0.1).all(axis=1) & (scene.means[:, 2] > 0)
    body = {"version": before["version"], "floaters": False, "outline": {"corners": corners, "camera": camera}}
    edited = http.post(f"{url}:clean", json=body).json()
    assert edited["outlined"] == inside.sum() > 0
    assert edited["splats"] == len(scene) - inside.sum() and edited["floaters"] == 0
    for wrong in ({"corners": corners[:2]}, {"camera": {"frame": 100}}, {"corners": [[0, 1e9]] * 3}):
        outline = {"corners": corners, "camera": camera} | wrong
        refused = http.post(f"{url}:clean", json={**body, "version": edited["version"], "outline": outline})
        assert refused.status_code == 422, refused.text
    assert http.post(f"{url}:revert", json={"version": edited["version"], "to": before["version"]}).status_code == 200


def test_a_version_of_another_unit_takes_no_metres_along(service: Any, done: CaptureOut, job: str) -> None:
    """Earlier versions are of another run: the scale that was measured since is not theirs."""
    http, url = service.http, f"reconstructions/{job}"
    before = http.get(url).json()["version"]
    body = {"version": before, "floaters": False, "box": {"low": [-1e6] * 3, "high": [1e6] * 3}}
    cleaned = http.post(f"{url}:clean", json=body).json()["version"]
    (folder,) = Path(http.get("system").json()["data_folder"]).glob(f"reconstructions/{job}")
    scale = {"revision": 3, "metres_per_unit": 2.0, "version": cleaned, "since": before}
    (folder / "scale.json").write_text(json.dumps(scale))
    assert http.get(f"{url}/scale").json()["metres_per_unit"] == 2.0
    same = http.post(f"{url}:revert", json={"version": cleaned, "to": cleaned}).json()["version"]
    assert http.get(f"{url}/scale").json()["metres_per_unit"] == 2.0
    assert http.post(f"{url}:revert", json={"version": same, "to": before}).status_code == 200
    assert http.get(f"{url}/scale").json()["metres_per_unit"] is None
    (folder / "scale.json").unlink()
