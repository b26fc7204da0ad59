"""Captures on several devices that start together, or not at all."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spiked.recording import open_recording
from spiked.recording.time_base import offset

from .conftest import Service, write_recording

SIMULATED = "sim:?width=96&height=64&pace=1"


@pytest.fixture
def own(daemon: Any) -> Service:
    return Service(daemon())


def body(*sources: str, **more: Any) -> dict[str, Any]:
    return {"captures": [{"source": source, "reconstruct": False, **more} for source in sources]}


def ended(service: Service, group: str) -> dict[str, Any]:
    deadline = time.monotonic() + 60
    while (found := service.http.get(f"groups/{group}").json())["offsets"] is None:
        assert time.monotonic() < deadline, found
        time.sleep(0.1)
    return dict(found)


def test_a_group_starts_and_stops_together_and_knows_its_offset(own: Service, tmp_path: Path) -> None:
    answer = own.http.post("groups", json=body(f"{SIMULATED}&seed=1", f"{SIMULATED}&seed=2"))
    assert answer.status_code == 201, answer.text
    group = answer.json()["id"]
    assert answer.headers["location"].endswith(f"groups/{group}")
    assert [one["group"] for one in answer.json()["captures"]] == [group, group]
    assert answer.json()["offsets"] is None
    ids = [one["id"] for one in answer.json()["captures"]]
    alone = own.capture(reconstruct=False)
    assert alone.group is None
    listed = own.http.get("captures", params={"group": group}).json()["items"]
    assert [one["id"] for one in listed] == ids[::-1]
    deadline = time.monotonic() + 60
    while not all(one.counters and one.counters.received for one in map(own.client.capture, ids)):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert own.http.post(f"groups/{group}:stop").status_code == 202
    found = ended(own, group)
    assert [one["state"] for one in found["captures"]] == ["complete", "complete"]
    recordings = [open_recording(tmp_path / "data" / "captures" / one / "recording.dat") for one in ids]
    expected = offset(*recordings)
    (told,) = found["offsets"]
    assert told == {
        "capture_id": ids[1],
        "offset_s": expected.seconds,
        "sigma_s": expected.sigma_s,
        "reason": "",
    }


def test_replayed_recordings_are_captured_bit_exact(own: Service, tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("left.dat", "right.dat")]
    for path in paths:
        write_recording(path)
    group = own.http.post("groups", json=body(*(f"replay:{path}?pace=0" for path in paths))).json()["id"]
    found = ended(own, group)
    for path, one in zip(paths, found["captures"], strict=True):
        stored = own.http.get(f"captures/{one['id']}/recording").content
        np.testing.assert_array_equal(np.frombuffer(stored, np.uint8), np.fromfile(path, np.uint8))


@pytest.mark.parametrize(
    ("second", "status", "told"),
    [
        (f"{SIMULATED}&seed=9", 409, "still running on sim:?width=96&height=64&seed=9"),
        ("replay:nothing.dat", 422, "nothing.dat"),
        (f"{SIMULATED}&seed=1&pace=0", 422, "named twice"),
    ],
)
def test_one_that_cannot_start_keeps_all_from_starting(
    own: Service, tmp_path: Path, second: str, status: int, told: str
) -> None:
    busy = own.client.start_capture(f"{SIMULATED}&seed=9", reconstruct=False)
    second = second.replace("nothing.dat", str(tmp_path / "nothing.dat"))
    refused = own.http.post("groups", json=body(f"{SIMULATED}&seed=1", second))
    assert refused.status_code == status, refused.text
    assert told in refused.json()["detail"]
    assert [one.id for one in own.client.captures()] == [busy.id]
    assert {path.name for path in (tmp_path / "data" / "captures").iterdir()} == {busy.id}


def test_a_group_needs_room_for_all_of_it(daemon: Any, tmp_path: Path) -> None:
    own = Service(daemon("--set", "limit_captures=2"))
    three = body(*(f"{SIMULATED}&seed={seed}" for seed in range(3)))
    assert own.http.post("groups", json=three).status_code == 409
    free = own.http.get("system").json()["disk"]["free_bytes"]
    frames = round(0.6 * free / 768)
    sources = [f"{SIMULATED}&seed={seed}" for seed in range(2)]
    assert own.http.post("groups", json=body(*sources, frames=frames)).status_code == 507
    assert own.http.get("captures").json()["items"] == []
    assert list((tmp_path / "data" / "captures").iterdir()) == []
    assert own.http.post("groups", json=body(*sources, frames=2000)).status_code == 201


def test_what_is_no_group_is_refused(service: Any) -> None:
    assert service.http.post("groups", json=body(SIMULATED)).status_code == 422
    assert service.http.post("groups", json=body(*[SIMULATED] * 17)).status_code == 422
    unknown = "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e11"
    assert service.http.get(f"groups/{unknown}").status_code == 404
    assert service.http.post(f"groups/{unknown}:stop").status_code == 404
