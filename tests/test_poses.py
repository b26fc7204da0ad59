"""Pose files: what is appended is read back by ranges, a crash leaves whole records only, and TUM files become some."""

from pathlib import Path

import numpy as np
import pytest

from spiked.errors import SceneError
from spiked.pose import exp_so3
from spiked.poses import PoseAppender, PoseFile, Records, convert_tum
from spiked.trajectory import Trajectory


def made(count: int, first: int = 0) -> Trajectory:
    rng = np.random.default_rng(first)
    times = np.round((np.arange(first, first + count) + 0.5) / 20_000, 9)
    return Trajectory(times, exp_so3(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def written(path: Path, *parts: Trajectory) -> PoseFile:
    with PoseAppender(path) as file:
        for part in parts:
            file.append(part)
        file.sync()
    return PoseFile(path)


def test_what_is_appended_at_any_time_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "a.poses"
    first, second = made(100), made(50, 100)
    assert len(written(path, first)) == 100
    poses = written(path, second)
    found = poses.trajectory(range(150))
    np.testing.assert_array_equal(found.times_s, np.concatenate([first.times_s, second.times_s]))
    np.testing.assert_allclose(found.matrices()[100:], second.matrices(), atol=1e-14)
    every_third = poses.trajectory(range(20, 120, 3))
    np.testing.assert_array_equal(every_third.centres, found.centres[20:120:3])


def test_the_states_go_with_the_poses(tmp_path: Path) -> None:
    with PoseAppender(tmp_path / "a.poses") as file:
        file.append(made(3), np.array([b"boot", b"degraded", b""]))
    assert PoseFile(tmp_path / "a.poses").records(range(3))["state"].tolist() == [b"boot", b"degraded", b""]


def test_ranges_and_neighbours_are_those_of_the_times(tmp_path: Path) -> None:
    poses, path = written(tmp_path / "a.poses", made(1000)), made(1000)
    for begin_s, end_s in ((0, 1), (0.01, 0.02), (path.times_s[17], path.times_s[40]), (2, 3), (0.02, 0.01)):
        rows = poses.between(begin_s, end_s)
        np.testing.assert_array_equal(poses.trajectory(rows).times_s, path.between(begin_s, end_s).times_s)
    for time_s in (-1.0, 0.0, 0.0123456, 0.04999, 0.06):
        row = path.nearest(np.array([time_s]), 1e-3)[0]
        assert poses.nearest(time_s, 1e-3) == (row if row >= 0 else None)
    assert PoseFile(tmp_path / "a.poses").nearest(0.0, 0.0) is None


@pytest.mark.parametrize("kept", [0, 5, 127, 128, 130, 128 + 72, 128 + 5 * 72 + 71])
def test_what_a_crash_leaves_of_a_record_does_not_count(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "a.poses"
    written(path, made(10))
    with path.open("r+b") as file:
        file.truncate(kept)
    whole = max(0, kept - 128) // 72
    if kept >= 128:
        assert len(PoseFile(path)) == whole
    poses = written(path, made(10, 10))
    expected = np.concatenate([made(10).times_s[:whole], made(10, 10).times_s])
    np.testing.assert_array_equal(poses.trajectory(range(len(poses))).times_s, expected)


def test_what_is_no_pose_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.poses"
    written(path, made(2))
    for content in (b"", b"SPKPOS", b"# timestamp\n0 0 0 0 0 0 0 1\n", path.read_bytes().replace(b"S8", b"S9")):
        (tmp_path / "b.poses").write_bytes(content)
        with pytest.raises(SceneError, match=r"b\.poses"):
            PoseFile(tmp_path / "b.poses")
    with pytest.raises(SceneError, match="cannot read"):
        PoseFile(tmp_path / "none.poses")
    with PoseAppender(path) as file, pytest.raises(SceneError, match="order"):
        file.append(made(1))


def test_a_tum_file_becomes_a_pose_file_sorted_or_not(tmp_path: Path) -> None:
    tum, poses = tmp_path / "a.tum", tmp_path / "a.poses"
    path = made(40_000)
    path.write_tum(tum)
    convert_tum(tum, poses, lambda times: np.where(times < 1, b"boot", b"track"))
    found = PoseFile(poses)
    np.testing.assert_allclose(found.trajectory(range(40_000)).matrices(), path.matrices(), atol=1e-8)
    assert found.records(range(19_998, 20_002))["state"].tolist() == [b"boot"] * 2 + [b"track"] * 2
    lines = tum.read_text().splitlines()
    tum.write_text("\n".join([*lines[:1], *lines[:0:-1]]))
    convert_tum(tum, tmp_path / "b.poses")
    np.testing.assert_array_equal(PoseFile(tmp_path / "b.poses").records(range(9))["time_s"], path.times_s[:9])
    tum.write_text("0 0 0\n")
    with pytest.raises(SceneError, match="line 1"):
        convert_tum(tum, tmp_path / "c.poses")
    assert {file.name for file in tmp_path.iterdir()} == {"a.tum", "a.poses", "b.poses"}


class Counted(PoseFile):
    """Counts the records that are looked at."""

    looked_at = 0

    def time_s(self, row: int) -> float:
        self.looked_at += 1
        return super().time_s(row)

    def records(self, rows: range) -> Records:
        self.looked_at += len(rows)
        return super().records(rows)


def test_only_what_is_asked_for_is_read(tmp_path: Path) -> None:
    path = tmp_path / "long.poses"
    count = 1_000_000
    with PoseAppender(path) as file:
        table = np.zeros((count, 8))
        table[:, 0], table[:, 7] = (np.arange(count) + 0.5) / 20_000, 1
        file.append_table(table)
    assert path.stat().st_size == 128 + 72 * count
    poses = Counted(path)
    assert len(poses.trajectory(poses.between(25, 25.05))) == 1000
    assert len(poses.trajectory(poses.between(0, 50)[::2000])) == 500
    assert poses.nearest(49.9, 1) is not None
    assert poses.looked_at < 1000 + 500 + 5 * 22
