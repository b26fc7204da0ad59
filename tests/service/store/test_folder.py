"""The data folder has one owner and no way out of it."""

import subprocess
import sys
from pathlib import Path

import pytest
from spiked_service.base.ids import new_id
from spiked_service.store.folder import DataFolder

from spiked.errors import ConfigurationError


def test_a_second_owner_is_refused_until_the_first_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib\n"
        "from spiked_service.store.folder import DataFolder\n"
        "owner = DataFolder(pathlib.Path(sys.argv[1]))\n"
        "print('mine', flush=True)\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "mine\n"
        with pytest.raises(ConfigurationError, match="another service uses"):
            DataFolder(tmp_path)
        other.kill()
        other.wait()
    DataFolder(tmp_path).close()


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="choose another with --data"):
        DataFolder(tmp_path / "file" / "data")


@pytest.mark.parametrize("text", ["", "..", "../../etc", "x", "a/b", "01a1fcf4-b7a0-7452-97d1-c7971373dd38/.."])
def test_no_text_but_an_id_becomes_a_path(tmp_path: Path, text: str) -> None:
    folder = DataFolder(tmp_path)
    for place in (folder.capture, folder.reconstruction, folder.upload, folder.recording):
        with pytest.raises(ValueError, match="is not an id"):
            place(text)


def test_what_kills_left_half_done_is_swept(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path)
    kept, doomed, purged = folder.capture(new_id()), folder.reconstruction(new_id()), folder.capture(new_id())
    for one in (kept, doomed, purged):
        one.mkdir()
        (one / "thumbnail.webp.part").touch()
    (kept / "thumbnail.webp").touch()
    doomed.rename(doomed.with_name(f".{doomed.name}.removed"))
    folder.begin_purge(purged.name)
    assert folder.sweep() == 3
    assert [path.name for path in folder.contents()[0] and kept.iterdir()] == ["thumbnail.webp"]
    assert folder.contents()[0] == {kept.name} and folder.contents()[1] == set()
    assert folder.purged() == {purged.name}, "its jobs are to be deleted first"
