"""The scale by a rig of two cameras over HTTP."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spiked_service.api.app import create_app
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.base.health import Health
from spiked_service.daemon import build_services, open_data_store
from spiked_service.events.bus import Bus
from spiked_service.results.versions import RecordedPath
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.tokens import Tokens
from starlette.testclient import TestClient

from spiked.pose import exp_so3
from spiked.recording import RecordingWriter, sidecar_path
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory

from ...published_map import published_map

SENSOR = Sensor(32, 16, 1000.0)
START_NS = 1_800_000_000_000_000_000
DISTANCE, BASELINE_M, OFFSET_S = 0.4, 0.12, 0.25


class Rig:
    """A service with the recordings of two cameras of a rig and a map with both paths."""

    def __init__(self, http: TestClient, captures: tuple[str, str], map_id: str, alone_id: str) -> None:
        self.http = http
        self.captures = captures
        self.url = f"/api/v1/reconstructions/{map_id}/scale"
        self.alone = f"/api/v1/reconstructions/{alone_id}/scale"

    def revision(self) -> int:
        return int(self.http.get(self.url).json()["revision"])

    def ask(self, **more: Any) -> Any:
        return self.http.post(f"{self.url}:baseline", json={"revision": self.revision(), "baseline_m": 0.12, **more})


def uploaded(http: TestClient, path: Path, start_s: float) -> str:
    """The capture of a recording whose first frame came at `start_s` by the clock of its host."""
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(np.zeros((1000, SENSOR.frame_bytes), np.uint8))
        for frame in (0, 500, 999):
            writer.clock_pair(frame, START_NS + round(1e9 * (start_s + frame / SENSOR.frame_rate_hz)))
    content = path.read_bytes()
    body = {"name": path.name, "bytes": len(content), "sidecar": json.loads(sidecar_path(path).read_text())}
    upload = http.post("/api/v1/uploads", json=body).json()["id"]
    headers = {"Upload-Offset": "0", "Content-Type": "application/octet-stream"}
    assert http.patch(f"/api/v1/uploads/{upload}", content=content, headers=headers).status_code == 200
    return str(http.post(f"/api/v1/uploads/{upload}:complete").json()["id"])


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("rig")
    bus = Bus()
    store = open_data_store(folder / "data", BusNotifier(bus))
    app = create_app(build_services(ReloadableSettings({}), Tokens(folder / "data"), store, bus, Health()))
    http = TestClient(app, base_url="http://127.0.0.1:8650")
    first, second = uploaded(http, folder / "left.dat", 0.0), uploaded(http, folder / "right.dat", OFFSET_S)
    times = np.linspace(0.0, 1.0, 201)
    turns = exp_so3(np.stack([0.3 * np.sin(4 * times), 0.2 * times, 0.1 * np.cos(times)], axis=1))
    centres = np.stack([np.sin(3 * times), times, 0.2 * times**2], axis=1)
    late = times >= OFFSET_S
    beside = (centres + turns @ [DISTANCE, 0, 0])[late]
    path, other = Trajectory(times, turns, centres), Trajectory(times[late] - OFFSET_S, turns[late], beside)
    scene, optics = Scene.empty(1), Intrinsics.from_fov(SENSOR.width, SENSOR.height, 60)
    others = [RecordedPath(second, SENSOR.frame_rate_hz, other)]
    both = published_map(store, first, scene, path, optics, others=others)
    yield Rig(http, (first, second), both, published_map(store, first, scene, path, optics))
    store.close()


def test_the_distance_of_two_cameras_gives_metres(rig: Rig) -> None:
    found = rig.ask()
    assert found.status_code == 200, found.text
    told = found.json()
    assert told["offset_s"] == pytest.approx(OFFSET_S) and told["poses"] == 151, "by the clocks of both recordings"
    assert told["scale"]["metres_per_unit"] == pytest.approx(BASELINE_M / DISTANCE, rel=1e-5)
    assert (told["scale"]["source"], told["scale"]["sigma"] < 1e-3) == ("baseline", True)
    assert rig.http.get(rig.url).json() == told["scale"]
    stated = rig.ask(offset_s=OFFSET_S + 0.01).json()
    assert stated["offset_s"] == OFFSET_S + 0.01
    assert stated["scale"]["metres_per_unit"] != pytest.approx(BASELINE_M / DISTANCE, rel=1e-5)


@pytest.mark.parametrize(
    ("body", "status", "told"),
    [
        ({"offset_s": 7.0}, 422, "at 0 moments only: state the offset"),
        ({"offset_s": -0.5}, 422, "not on one rig"),
        ({"path": 2}, 404, "has no path 2; GET paths lists"),
        ({"baseline_m": 0.0}, 422, "greater than 0"),
        ({"revision": 99}, 409, "read it and change that one"),
    ],
)
def test_what_is_no_rig_is_refused(rig: Rig, body: dict[str, Any], status: int, told: str) -> None:
    before = rig.http.get(rig.url).json()
    answer = rig.ask(**body)
    assert answer.status_code == status and told in answer.json()["detail"], answer.text
    assert rig.http.get(rig.url).json() == before


def test_a_map_of_one_camera_has_no_baseline(rig: Rig) -> None:
    answer = rig.http.post(f"{rig.alone}:baseline", json={"revision": 0, "baseline_m": BASELINE_M})
    assert answer.status_code == 422 and "merge it with" in answer.json()["detail"], answer.text


def test_an_offset_that_no_clock_knows_is_asked_for(rig: Rig) -> None:
    second = rig.captures[1]
    assert rig.http.delete(f"/api/v1/captures/{second}").is_success
    assert rig.http.post(f"/api/v1/captures/{second}:purge").is_success
    answer = rig.ask()
    assert answer.status_code == 422 and answer.json()["detail"].endswith("give offset_s"), answer.text
    assert second in answer.json()["detail"]
    assert rig.ask(offset_s=OFFSET_S).status_code == 200, "the path of a removed capture stays"
