"""Published versions of a reconstruction: which are kept, and what a reader of an older index finds."""

import resource
from pathlib import Path

import numpy as np
import pytest
from spiked_service.results.versions import Publisher, RecordedPath, at, forget_incomplete, newest, versions

from spiked.scene import Scene
from spiked.trajectory import Trajectory
from spiked.whole_files import write_atomically

from ...small_disk import fill, small_disk


def test_files_of_the_last_three_versions_are_kept_and_old_versions_thinned(tmp_path: Path) -> None:
    publisher = Publisher(tmp_path)
    assert newest(tmp_path) is None
    trajectory = Trajectory(np.array([0.5]), np.eye(3)[None], np.zeros((1, 3)))
    seen = []
    for number in range(1, 61):
        published = publisher.publish(Scene.empty(1), trajectory, white=0.1 * number)
        assert newest(tmp_path) == published
        seen.append(published)
        assert all((tmp_path / old.scene).exists() and (tmp_path / old.trajectory).exists() for old in seen[-3:])
    kept = versions(tmp_path)
    assert [one.version for one in kept] == publisher.kept
    assert len(kept) <= 35 and kept[0].version == 1 and kept[-1].version == 60
    assert at(tmp_path, kept[5].version) == kept[5]
    assert at(tmp_path, 2) is None
    files = {path.name for path in tmp_path.iterdir()}
    slots = {one.slots for one in kept[-3:]}
    assert all(one.slots is None for one in kept[:-3]) and None not in slots
    assert files == {name for one in kept for name in (one.scene, one.trajectory)} | slots | {"published.json"}
    assert Publisher(tmp_path).publish(Scene.empty(1), trajectory, 0.1).version == 61


def test_paths_of_other_recordings_go_with_their_version(tmp_path: Path) -> None:
    publisher = Publisher(tmp_path)
    trajectory = Trajectory(np.array([0.5, 1.5]), np.eye(3)[None].repeat(2, 0), np.ones((2, 3)))
    others = [RecordedPath("one", 100.0, trajectory), RecordedPath("other", 200.0, trajectory)]
    for _ in range(60):
        publisher.publish(Scene.empty(1), trajectory, 0.1, others=others)
    kept = versions(tmp_path)
    assert [(path.capture_id, path.frame_rate_hz, path.poses) for path in kept[-1].paths] == [
        ("one", 100.0, 2),
        ("other", 200.0, 2),
    ]
    listed = {path.trajectory for one in kept for path in one.paths}
    assert {path.name for path in tmp_path.glob("path-*")} == listed and len(listed) == 2 * len(kept) < 80


def test_a_held_version_outlasts_many_and_can_be_made_the_newest_again(tmp_path: Path) -> None:
    publisher = Publisher(tmp_path)
    trajectory = Trajectory(np.array([0.5, 1.5]), np.eye(3)[None].repeat(2, 0), np.ones((2, 3)))
    for number in range(1, 9):
        best = publisher.publish(Scene.empty(1), trajectory, white=0.1 * number, psnr_db=20.0 + number)
    publisher.protect_newest()
    for _ in range(200):
        publisher.publish(Scene.empty(1), trajectory, white=5.0)
    again = publisher.again(best)
    assert newest(tmp_path) == again and again.version == 209
    assert (again.white, again.psnr_db, again.poses) == (best.white, best.psnr_db, best.poses)
    assert best.version in publisher.kept and len(publisher.kept) <= 36
    assert (tmp_path / again.scene).read_bytes() == (tmp_path / best.scene).read_bytes()
    assert (tmp_path / again.trajectory).read_bytes() == (tmp_path / best.trajectory).read_bytes()


def test_of_a_file_that_cannot_be_written_nothing_is_left(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a", b"old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))  # as a full disk
    try:
        with pytest.raises(OSError, match="large"):
            write_atomically(tmp_path / "a", bytes(1000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", b"old")]


def test_of_a_version_that_has_no_room_nothing_is_left(tmp_path: Path) -> None:
    """Whichever of its files is the first without room: slots, scene, poses, or the list."""
    rng = np.random.default_rng(0)
    shapes = ((2000, 3), (2000, 4), (2000, 3), (2000,), (2000, 1))
    scene = Scene(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    trajectory = Trajectory(np.arange(2000) + 0.5, np.eye(3)[None].repeat(2000, 0), np.zeros((2000, 3)))
    with small_disk(tmp_path / "data", 4) as disk:
        folder = disk / "job"
        folder.mkdir()
        publisher = Publisher(folder)
        first = publisher.publish(scene, trajectory, 0.1)
        files = sorted(folder.iterdir())
        refused = 0
        for room in range(0, 1_000_000, 40_000):
            others = fill(disk, left_bytes=room)
            try:
                publisher.publish(scene, trajectory, 0.1)
            except OSError:
                refused += 1
                assert sorted(folder.iterdir()) == files, room
                assert publisher.version == 1 and newest(folder) == first
            else:
                break
            finally:
                others.unlink()
        assert refused >= 4 and publisher.version == 2


@pytest.mark.parametrize("harm", ["no scene", "part of a scene", "no poses", "no other path"])
def test_a_version_whose_files_are_not_whole_is_not_listed(tmp_path: Path, harm: str) -> None:
    publisher = Publisher(tmp_path)
    trajectory = Trajectory(np.array([0.5]), np.eye(3)[None], np.zeros((1, 3)))
    others = [RecordedPath("one", 100.0, trajectory)]
    for _ in range(3):
        publisher.publish(Scene.empty(1), trajectory, 0.1, others=others)
    assert forget_incomplete(tmp_path) == []
    second = versions(tmp_path)[1]
    if harm == "part of a scene":
        (tmp_path / second.scene).write_bytes((tmp_path / second.scene).read_bytes()[:-1])
    else:
        gone = {"no scene": second.scene, "no poses": second.trajectory, "no other path": second.paths[0].trajectory}
        (tmp_path / gone[harm]).unlink()
    assert Publisher(tmp_path).kept == [1, 3], "whoever goes on does not list it again"
    assert forget_incomplete(tmp_path) == [2]
    assert [one.version for one in versions(tmp_path)] == [1, 3]
    for one in versions(tmp_path):
        (tmp_path / one.scene).unlink()
    assert forget_incomplete(tmp_path) == [1, 3]
    assert versions(tmp_path) == []
