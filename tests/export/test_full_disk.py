"""An export onto a full disk ends with an error, leaves nothing behind and an earlier file as it was."""

import errno
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import SceneError
from spiked.export import KINDS, ExportKind, ExportOptions, ExportSource, find_kind
from spiked.whole_files import KeptErrors, whole_file, whole_folder

from ..room_map import room_map
from ..small_disk import fill, small_disk

OPTIONS = ExportOptions(views=3, depth="expected", resolution=48)
NO_ROOM = OSError(errno.ENOSPC, "full")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MiB."""
    with small_disk(tmp_path / "disk", 4) as place:
        yield place


def contents(folder: Path) -> dict[str, bytes | None]:
    """Of all files below a folder by their paths; None of folders."""
    return {str(path): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def earlier(kind: ExportKind, place: Path) -> None:
    """What is there already: a file, or a folder with a file."""
    if kind.folder:
        place.mkdir()
        place /= "metadata.yaml"
    place.write_text("earlier")


@pytest.mark.parametrize("left_kib", [0, 64])
@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
def test_every_format_is_whole_or_not_at_all(source: ExportSource, disk: Path, kind: ExportKind, left_kib: int) -> None:
    earlier(kind, disk / "room")
    fill(disk, left_kib << 10)
    before = contents(disk)
    for place in (disk / "room", disk / "new"):
        with pytest.raises(OSError, match="No space left on device") as error:
            kind.write(source, place, OPTIONS)
        assert error.value.errno == errno.ENOSPC
        assert contents(disk) == before
    (disk / "others").unlink()
    if kind.name != "nexus":  # which is larger than the disk
        kind.write(source, disk / "new", OPTIONS)
        assert contents(disk / "new" if kind.folder else disk)


@pytest.mark.parametrize(("name", "written_kib"), [("mcap", 400), ("nexus", 3000), ("ros-bag", 600), ("depth", 1200)])
def test_a_disk_that_fills_in_the_middle(source: ExportSource, disk: Path, name: str, written_kib: int) -> None:
    fill(disk, written_kib << 10)
    with pytest.raises(OSError, match="No space left") as error:
        find_kind(name).write(source, disk / "new", OPTIONS)
    if name != "ros-bag":  # SQLite has removed it by then
        taken_mib = float(str(error.value).split()[-2])
        assert written_kib / 2 < taken_mib * 1024 < written_kib + 100
    assert [path.name for path in disk.iterdir()] == ["others"]


def test_the_command_says_what_to_do(disk: Path, tmp_path: Path) -> None:
    room = room_map(3, (0.0,)).write(tmp_path / "room")
    fill(disk, 200 << 10)
    done = CliRunner().invoke(app, ["export", str(room), "ply", "-o", str(disk / "room.ply")])
    assert str(done.exception) == (
        f"--out {disk}/room.ply cannot be written: No space left on device after 0.2 MiB; name another place, or free "
        "disk space"
    )


def test_a_file_keeps_its_mode_and_a_link_stays_a_link(tmp_path: Path) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("earlier")
    file.chmod(0o640)
    link.symlink_to(file)
    with whole_file(link) as part:
        part.write_text("new")
        assert file.read_text() == "earlier"
    assert link.is_symlink() and file.read_text() == "new" and stat.S_IMODE(file.stat().st_mode) == 0o640
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_is_as_it_was_after_any_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("earlier")
    for error in (SceneError("no splats"), KeyboardInterrupt(), NO_ROOM, OSError(errno.EACCES, "no")):
        with pytest.raises(type(error)), whole_file(tmp_path / "file") as part:
            part.write_text("new")
            raise error
        assert contents(tmp_path) == {str(tmp_path / "file"): b"earlier"}


def test_a_device_is_written_to_directly() -> None:
    with whole_file(Path("/dev/null")) as part:
        assert part == Path("/dev/null")


def test_a_folder_keeps_its_other_files(tmp_path: Path) -> None:
    place = tmp_path / "project"
    (place / "images").mkdir(parents=True)
    for name in ("database.db", "images/1.png", "images/2.png"):
        (place / name).write_text("earlier")
    with whole_folder(place) as folder:
        assert folder.name == "project" and not list(folder.iterdir())
        (folder / "images").mkdir()
        (folder / "images" / "2.png").write_text("new")
        (folder / "sparse").mkdir()
        (folder / "sparse" / "points").write_text("new")
    found = {str(path.relative_to(place)): path.read_text() for path in place.rglob("*") if path.is_file()}
    assert found == {"database.db": "earlier", "images/1.png": "earlier", "images/2.png": "new", "sparse/points": "new"}


def test_files_that_do_not_belong_to_a_new_folder_are_removed(tmp_path: Path) -> None:
    place = tmp_path / "project"
    (place / "images").mkdir(parents=True)
    for name in ("database.db", "images/1.png", "images/2.png"):
        (place / name).write_text("earlier")
    with whole_folder(place, stale=("images/*",)) as folder:
        (folder / "images").mkdir()
        (folder / "images" / "2.png").write_text("new")
    found = {str(path.relative_to(place)): path.read_text() for path in place.rglob("*") if path.is_file()}
    assert found == {"database.db": "earlier", "images/2.png": "new"}


def test_a_folder_and_those_above_it_are_gone_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(SceneError), whole_folder(tmp_path / "a" / "b" / "c") as folder:
        (folder / "file").write_text("new")
        raise SceneError("no splats")
    assert not list(tmp_path.iterdir())
    with whole_folder(tmp_path / "a" / "b" / "c") as folder:
        (folder / "file").write_text("new")
    assert [path.name for path in sorted(tmp_path.rglob("*"))] == ["a", "b", "c", "file"]


def test_a_folder_of_its_own_holds_nothing_else(tmp_path: Path) -> None:
    for name in ("old.bag", "a.yaml", ".spiked-0123abcd.part"):  # the last one of a process that was killed
        (tmp_path / name).write_text("earlier")
    with whole_folder(tmp_path, ("*.bag", "a.yaml")) as folder:
        (folder / "a.yaml").write_text("new")
        (folder / "new.bag").write_text("new")
    assert {path.name: path.read_text() for path in tmp_path.glob("[a-z]*")} == {"a.yaml": "new", "new.bag": "new"}
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SceneError, match=r"holds notes\.txt"), whole_folder(tmp_path, ("*.bag", "a.yaml")):
        pass


def test_errors_of_writing_are_kept_until_the_end(disk: Path) -> None:
    fill(disk, 8192)
    data = np.arange(5000, dtype=np.uint32)
    with pytest.raises(OSError, match="No space left"), KeptErrors(disk / "file") as file:
        assert file.write(b"head") == 4
        file.check()
        assert file.write(data) == data.nbytes and file.error is not None
        assert file.write(b"more") == 4 and file.tell() == 8 + data.nbytes and file.truncate(3) == 3
        with pytest.raises(OSError, match="No space left"):
            file.check()
        raise RuntimeError("the library has failed")
    assert file.closed and (disk / "file").read_bytes() == (b"head" + data.tobytes())[:8192]
    with KeptErrors(disk.parent / "file") as file:
        file.write(b"whole")
    assert (disk.parent / "file").read_bytes() == b"whole"


def test_an_interrupt_is_not_taken_for_a_full_disk() -> None:
    with pytest.raises(KeyboardInterrupt), KeptErrors(Path("/dev/full")) as file:
        file.write(b"data")
        assert file.error is not None and file.error.errno == errno.ENOSPC
        raise KeyboardInterrupt
