"""The scale of a scene over HTTP."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spiked.client import CaptureOut


def test_a_scale_is_stored_once_and_answers_are_in_metres(service: Any, done: CaptureOut, job: str) -> None:
    http, url = service.http, f"reconstructions/{job}"
    before = http.get(f"{url}/scale").json()
    assert (before["revision"], before["metres_per_unit"]) == (0, None)
    assert http.get(f"{url}/trajectory?metric=true").status_code == 404
    own = http.get(f"{url}/trajectory?step=50").json()
    stored = http.put(f"{url}/scale", json={"revision": 0, "metres_per_unit": 2.0, "sigma": 0.01})
    assert stored.status_code == 200, stored.text
    assert stored.json() | {"version": 0} == {
        "revision": 1, "metres_per_unit": 2.0, "sigma": 0.01, "source": "length", "up": None, "version": 0, "since": 0,
    }  # fmt: skip
    assert http.put(f"{url}/scale", json={"revision": 0, "metres_per_unit": 3.0}).status_code == 409
    metric = http.get(f"{url}/trajectory?step=50&metric=true").json()
    np.testing.assert_allclose(metric["positions"], 2 * np.array(own["positions"]), atol=1e-8)
    point = http.get(f"{url}/point?x=80&y=50").json()
    assert point["depth"] > 0 and point["depth_m"] == 2 * point["depth"]
    assert point["depth_m_sigma"] == pytest.approx(0.01 * point["depth_m"])
    up = http.put(f"{url}/scale", json={"revision": 1, "up": [0, 0, -3]}).json()
    assert up["up"] == [0, 0, -1] and up["metres_per_unit"] == 2.0
    turned = http.get(f"{url}/trajectory?step=50&metric=true").json()
    np.testing.assert_allclose(np.array(turned["positions"])[:, 1], 2 * np.array(own["positions"])[:, 2], atol=1e-8)
    plain, larger = (http.get(f"{url}/scene?metric={flag}").content for flag in ("false", "true"))
    assert plain != larger and b"comment scale_sigma 0.01\ncomment up 0.0 -1.0 0.0\n" in larger[:2000]
    for metric_flag, unit in (("false", "2.0"), ("true", "1.0")):
        answers = [http.get(f"{url}/{path}metric={metric_flag}") for path in ("scene?", "trajectory?format=tum&")]
        answers.append(http.get(f"{url}/exports/ply?metric={metric_flag}"))
        for answer in answers:
            assert answer.headers["X-Metres-Per-Unit"] == unit and answer.headers["X-Scale-Sigma"] == "0.01"
    view = http.post(f"{url}/views", json={"camera": {"frame": 100}, "output": "depth"})
    assert (view.headers["X-Metres-Per-Unit"], view.headers["X-Scale-Sigma"]) == ("2.0", "0.01")
    tum = http.get(f"{url}/trajectory?format=tum&metric=true").text
    assert tum.startswith("# unit m\n# metres_per_unit 1.0\n# scale_sigma 0.01\n# up 0.0 -1.0 0.0\n")
    studio = http.get(f"{url}/trajectory?format=nerfstudio&step=50").json()
    assert studio["scale"] == {"unit": "scene", "metres_per_unit": 2.0, "scale_sigma": 0.01, "up": [0, 0, -1]}
    assert http.delete(f"{url}/scale").json()["metres_per_unit"] is None


def test_up_by_gravity_points_or_the_floor(service: Any, done: CaptureOut, job: str) -> None:
    http, url = service.http, f"reconstructions/{job}"
    path = http.get(f"{url}/trajectory?step=51").json()
    revision = http.get(f"{url}/scale").json()["revision"]
    w, x, y, z = path["quaternions_wxyz"][1]
    down = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]  # the camera's y axis
    body = {"revision": revision, "gravity": [0, 9.81, 0], "frame": path["frames"][1]}
    found = http.post(f"{url}/scale:up", json=body)
    assert found.status_code == 200, found.text
    np.testing.assert_allclose(found.json()["up"], [-part for part in down], atol=1e-6)
    far = http.post(f"{url}/scale:up", json=body | {"revision": revision + 1, "frame": 100_000})
    assert far.status_code == 404 and "no pose within 30 ms of frame 100000" in far.json()["detail"], far.text
    points = [[0, 100, 0], [1, 100, 0], [0, 100, 1]]
    by_points = http.post(f"{url}/scale:up", json={"revision": revision + 1, "points": points}).json()
    np.testing.assert_allclose(by_points["up"], [0, -1, 0], atol=1e-9)
    line = [[0, 1, 0], [1, 1, 0], [2, 1, 0]]
    assert "on a line" in http.post(f"{url}/scale:up", json={"revision": revision + 2, "points": line}).json()["detail"]
    both = {"revision": revision + 2, "points": points, "gravity": [0, 1, 0]}
    assert http.post(f"{url}/scale:up", json=both).status_code == 422
    floor = http.post(f"{url}/scale:up", json={"revision": revision + 2})
    assert floor.status_code in (200, 422) and (floor.status_code == 200 or "floor" in floor.json()["detail"])
    assert http.delete(f"{url}/scale").json()["up"] is None


def test_a_scene_without_the_board_says_so(service: Any, job: str) -> None:
    revision = service.http.get(f"reconstructions/{job}/scale").json()["revision"]
    body = {"revision": revision, "board": "9x6", "square_m": 0.03}
    answer = service.http.post(f"reconstructions/{job}/scale:board", json=body)
    assert answer.status_code == 422 and "the board is in 0 of the pictures" in answer.json()["detail"]
    answer = service.http.post(f"reconstructions/{job}/scale:board", json=body | {"board": "big"})
    assert answer.status_code == 422 and "COLUMNSxROWS" in answer.json()["detail"]


def test_a_length_in_a_version_of_an_earlier_run_is_refused(service: Any, done: CaptureOut, job: str) -> None:
    http, url = service.http, f"reconstructions/{job}"
    first, last = (http.get(f"{url}/versions").json()["items"][at]["version"] for at in (0, -1))
    (folder,) = Path(http.get("system").json()["data_folder"]).glob(f"reconstructions/{job}")
    (folder / "scale.json").write_text(json.dumps({"revision": 5, "since": first}))
    assert http.get(f"{url}/scale").json()["since"] == first
    body = {"revision": 5, "metres_per_unit": 2.0}
    refused = http.put(f"{url}/scale", json=body | {"version": first})
    assert refused.status_code == 409 and "an earlier run" in refused.json()["detail"], refused.text
    assert http.get(f"{url}/scale").json()["metres_per_unit"] is None
    assert http.put(f"{url}/scale", json=body | {"version": last}).json()["version"] == last
    assert http.put(f"{url}/scale", json=body | {"version": 999}).status_code == 404
    (folder / "scale.json").unlink()


@pytest.mark.parametrize("body", [{"revision": 2, "up": [0, 0, 0]}, {"revision": 2, "metres_per_unit": -1.0}])
def test_what_is_no_scale_is_refused(service: Any, job: str, body: dict[str, Any]) -> None:
    assert service.http.put(f"reconstructions/{job}/scale", json=body).status_code == 422


def test_a_scene_without_tags_says_so(service: Any, job: str) -> None:
    revision = service.http.get(f"reconstructions/{job}/scale").json()["revision"]
    answer = service.http.post(f"reconstructions/{job}/scale:tag", json={"revision": revision, "side_m": 0.1})
    assert answer.status_code == 422 and "no tag" in answer.json()["detail"]
