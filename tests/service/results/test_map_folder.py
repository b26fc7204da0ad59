"""Results in a folder are replaced as a whole, with the scale that was measured in them."""

import errno
from pathlib import Path

import pytest
from spiked_service.results.map_folder import replacing
from spiked_service.results.scene_scale import SceneScale, forget_scale, read_scale, write_scale


@pytest.fixture
def before(tmp_path: Path) -> Path:
    """A folder with a result that was measured in metres."""
    for name in ("scene.ply", "trajectory.tum", "report.json", "paths/a.tum", "metric/scene.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("old")
    write_scale(tmp_path, SceneScale(metres_per_unit=2.0))
    return tmp_path


def contents(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_a_disk_that_is_full_leaves_the_result_before(before: Path) -> None:
    whole = contents(before)
    with pytest.raises(OSError, match="full"), replacing(before) as making:
        (making / "scene.ply").write_text("new")
        raise OSError(errno.ENOSPC, "full")
    assert contents(before) == whole


def test_a_new_result_has_neither_scale_nor_paths_of_the_one_before(before: Path) -> None:
    (before / ".making-1").mkdir()  # of a command that was killed
    with replacing(before) as making:
        for name in ("report.json", "scene.ply", "trajectory.tum"):
            (making / name).write_text("new")
    assert contents(before) == dict.fromkeys(("report.json", "scene.ply", "trajectory.tum"), "new")
    assert sorted(path.name for path in before.iterdir()) == ["report.json", "scene.ply", "trajectory.tum"]
    with replacing(before / "elsewhere") as making:
        (making / "report.json").write_text("new")
    assert contents(before / "elsewhere") == {"report.json": "new"}


def test_versions_of_an_earlier_run_have_no_metres(tmp_path: Path) -> None:
    assert not forget_scale(tmp_path, 0) and read_scale(tmp_path) == SceneScale()
    write_scale(tmp_path, SceneScale(metres_per_unit=2.0, up=(0.0, 0.0, 1.0)))
    assert forget_scale(tmp_path, 3)
    forgotten = read_scale(tmp_path)
    assert forgotten == SceneScale(revision=2, since=3)
    known = write_scale(tmp_path, forgotten.model_copy(update={"metres_per_unit": 0.5}))
    assert known.frame_of(3) is None and known.frame_of(4) is not None
    (tmp_path / "scale.json").write_text("{")
    assert forget_scale(tmp_path, 4) and read_scale(tmp_path).metres_per_unit is None
