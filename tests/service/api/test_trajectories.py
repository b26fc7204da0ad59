"""Trajectories of millions of poses: work for what is asked only, none for who has gone, a limit, old files."""

import asyncio
import io
import json
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import Request
from spiked_service.api.trajectories import Range, TrajectoryFormat, open_poses, trajectory_response
from spiked_service.base.limits import ConcurrencyLimit, OverloadedError
from spiked_service.results.published import Published

from spiked.frame_of_reference import KnownScale
from spiked.poses import PoseAppender, PoseFile, Records
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory

SENSOR = Sensor(400, 250, 20_000.0, intrinsics=Intrinsics.from_fov(400, 250, 60))
POSES = 200_000
RATE_HZ = 20_000


class Counted(PoseFile):
    """Counts the records that are read."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.read = 0

    def records(self, rows: range) -> Records:
        self.read += len(rows)
        return super().records(rows)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("poses") / "trajectory-000001.poses"
    table = np.random.default_rng(1).normal(size=(POSES, 8))
    table[:, 0] = (np.arange(POSES) + 0.5) / RATE_HZ
    with PoseAppender(file) as out:
        out.append_table(table, np.full(POSES, b"track"))
    return file


@pytest.fixture
def poses(path: Path) -> Counted:
    return Counted(path)


class Client:
    """Asks for a trajectory as a server would for it, and may go after some pieces."""

    def __init__(self, concurrency: ConcurrencyLimit | None = None) -> None:
        self.concurrency = concurrency or ConcurrencyLimit("trajectories", 8)
        self.body = b""
        self.status = 0
        self.pieces = 0

    def get(self, poses: PoseFile, kind: TrajectoryFormat, part: Range, *, leaves_after: int | None = None) -> bytes:
        async def go() -> None:
            gone = asyncio.Event()

            async def receive() -> dict[str, Any]:
                await gone.wait()
                return {"type": "http.disconnect"}

            async def send(message: Any) -> None:
                if message["type"] == "http.response.start":
                    self.status = message["status"]
                    return
                self.body += message["body"]
                self.pieces += 1
                if self.pieces == leaves_after:
                    gone.set()

            scope = {"type": "http", "method": "GET", "path": "/", "headers": [], "query_string": b""}
            answer = trajectory_response(Request(scope), poses, 1, SENSOR, kind, part, self.concurrency, KnownScale())
            await answer(scope, receive, send)

        asyncio.run(go())
        return self.body


ASKED = [
    (Range(None, None, 1000), range(0, POSES, 1000)),
    (Range(2.0, 2.05, 1), range(40_000, 41_000)),
    (Range(9.9, 100.0, 7), range(198_000, POSES, 7)),
    (Range(1.0, 1.5, 10_000), range(20_000, 30_000, 10_000)),
    (Range(1.0, 3.0, 1), range(20_000, 60_000)),
]


@pytest.mark.parametrize(("part", "rows"), ASKED)
def test_any_range_with_any_step_reads_what_is_asked_for(poses: Counted, part: Range, rows: range) -> None:
    found = json.loads(Client().get(poses, TrajectoryFormat.JSON, part))
    assert found["frames"] == list(rows)
    assert found["states"] == ["track"] * len(rows)
    np.testing.assert_allclose(found["positions"], PoseFile(poses.path).trajectory(rows).centres, atol=1e-9)
    assert {len(column) for name, column in found.items() if name != "version"} == {len(rows)}
    assert poses.read == len(rows)


@pytest.mark.parametrize("kind", [kind for kind in TrajectoryFormat if kind is not TrajectoryFormat.JSON])
def test_the_exports_read_what_is_asked_for(poses: Counted, kind: TrajectoryFormat, tmp_path: Path) -> None:
    part = PoseFile(poses.path).trajectory(range(20_000, 30_000))
    written = Client().get(poses, kind, Range(1.0, 1.5, 1))
    assert poses.read == len(part)
    match kind:
        case TrajectoryFormat.TUM:
            assert written.decode() == part.tum()
        case TrajectoryFormat.KITTI:
            assert written.decode() == part.kitti()
        case TrajectoryFormat.NERFSTUDIO:
            assert json.loads(written) == {**json.loads(part.nerfstudio(SENSOR)), "scale": {"unit": "scene"}}
            assert len(json.loads(written)["frames"]) == len(part)
        case TrajectoryFormat.COLMAP:
            with zipfile.ZipFile(io.BytesIO(written)) as archive:
                assert archive.read("images.txt").decode() == part.colmap()
                assert archive.read("cameras.txt").startswith(b"# CAMERA_ID")
                assert archive.testzip() is None


@pytest.mark.parametrize("kind", list(TrajectoryFormat))
def test_nothing_is_read_for_a_client_that_has_gone(poses: Counted, kind: TrajectoryFormat) -> None:
    client = Client()
    client.get(poses, kind, Range(None, None, 1), leaves_after=2)
    assert poses.read < POSES / 4
    assert client.concurrency.active == 0


def test_so_many_at_a_time(poses: Counted) -> None:
    concurrency = ConcurrencyLimit("trajectories", 1)
    with concurrency(), pytest.raises(OverloadedError, match="trajectories at a time"):
        Client(concurrency).get(poses, TrajectoryFormat.TUM, Range(None, None, 1000))
    assert poses.read == 0
    assert Client(concurrency).get(poses, TrajectoryFormat.TUM, Range(None, None, 1000))


def published(folder: Path, count: int) -> Published:
    times = (np.arange(count) + 0.5) / RATE_HZ
    trajectory = Trajectory(times, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))
    trajectory.write_tum(folder / "trajectory-000001.tum")
    names = {"scene": "scene-000001.ply", "trajectory": "trajectory-000001.tum"}
    return Published(version=1, white=1, at=datetime.now(UTC), splats=0, poses=count, scene_bytes=0, **names)


def test_a_tum_file_of_an_older_release_is_converted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    version = published(tmp_path, 100)
    timeline = tmp_path / "timeline.jsonl"
    lines = [{"time_s": 0, "frame": 49, "state": "boot"}, {"time_s": 0, "frame": 99, "state": "track"}]
    timeline.write_text("\n".join(map(json.dumps, lines)))
    poses = open_poses(tmp_path, version, SENSOR, timeline)
    assert poses.records(range(100))["state"].tolist() == [b"boot"] * 50 + [b"track"] * 50
    (tmp_path / "trajectory-000001.tum").unlink()  # not looked at again
    assert len(open_poses(tmp_path, version, SENSOR, timeline)) == 100


def test_many_who_ask_for_an_old_file_at_once_wait_for_one_conversion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import spiked_service.api.trajectories as module

    converted: list[Path] = []
    convert: Callable[..., None] = module.convert_tum

    def counted(tum: Path, *more: Any) -> None:
        converted.append(tum)
        convert(tum, *more)

    monkeypatch.setattr(module, "convert_tum", counted)
    version = published(tmp_path, 20_000)

    async def ask() -> list[PoseFile]:
        asked = (asyncio.to_thread(open_poses, tmp_path, version, None, tmp_path / "none") for _ in range(8))
        return list(await asyncio.gather(*asked))

    assert [len(one) for one in asyncio.run(ask())] == [20_000] * 8
    assert len(converted) == 1
