"""Damaged, mixed and hostile folders of spikes are named errors; checksums tell of what has changed."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spiked.datasets import Clip, compare, find_kind, recognise
from spiked.errors import SpikedError

from .layouts import LAYOUTS, Source

FRAME = bytes(12_500)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "set").mkdir()
    return tmp_path / "set"


def noise(frames: int, height: int = 250, width: int = 400) -> np.ndarray:
    return np.random.default_rng(frames).integers(0, 2, (frames, height, width), np.uint8)


def write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def fails(name: str, folder: Path, said: str) -> None:
    """Opening the folder, or reading all of it, is an error that says so."""
    with pytest.raises(SpikedError, match=said):
        for item in find_kind(name).open(folder).items:
            assert isinstance(item, Clip)
            for _ in item.blocks():
                pass


@pytest.mark.parametrize("name", ["usp-gaussian", "spikegs-real", "spikecv", "wision", "spice-hl3", "colmap"])
def test_a_folder_of_another_layout_is_refused(name: str, folder: Path) -> None:
    (folder / "notes.txt").write_text("nothing")
    fails(name, folder, f"has not the layout of {name}")
    with pytest.raises(SpikedError, match="no data set known here"):
        recognise(folder)
    fails(name, folder / "absent", "this is no folder")


def test_an_unknown_name_lists_those_that_are_known() -> None:
    with pytest.raises(SpikedError, match="known are usp-gaussian"):
        find_kind("nothing")


def test_clips_cut_short_or_missing_or_mixed(folder: Path) -> None:
    pixels = noise(200)
    frames = np.packbits(pixels[:, ::-1], axis=2, bitorder="little").reshape(200, -1)
    place = folder / "spike_data"
    for number, start in enumerate((0, 50, 100)):
        write(place / f"{number:03d}.dat", frames[start : start + 100].tobytes())
    (clip,) = find_kind("usp-gaussian").open(folder).items
    assert isinstance(clip, Clip) and clip.frames == 200
    middle = (place / "001.dat").read_bytes()
    (place / "001.dat").write_bytes(middle[:-7])
    fails("usp-gaussian", folder, "001.dat: 1249993 bytes are 99 frames .* the file is cut")
    (place / "001.dat").write_bytes(bytes(12_500) + middle[12_500:])
    fails("usp-gaussian", folder, "001.dat does not go on where 000.dat ends")
    (place / "001.dat").write_bytes(b"")
    fails("usp-gaussian", folder, "001.dat: the file is empty")
    (place / "001.dat").write_bytes(middle)
    write(folder / "transforms.json", b'{"fl_x": 1, "frames": [{"file_path": "a", "transform_matrix": %s}]}' % EYE)
    fails("usp-gaussian", folder, "3 clips and 1 poses")


EYE = b"[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"


def test_a_partial_last_frame_is_told_and_left_out(folder: Path) -> None:
    write(folder / "classA" / "a.dat", FRAME * 3 + b"rest")
    (clip,) = find_kind("recvidarreal").open(folder).items
    assert isinstance(clip, Clip) and clip.frames == 3 and clip.notes


def test_sequences_of_another_length_are_told(folder: Path) -> None:
    write(folder / "seq_01.dat", FRAME * 3)
    (clip,) = find_kind("outdoor-spike").open(folder).items
    assert isinstance(clip, Clip) and "20000" in clip.notes[0]


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ("other: 1", "neither spike_w nor spike_h"),
        ("spike_w: [", "not YAML"),
        ("spike_w: -8\nspike_h: 250", "spike_w"),
        ("spike_w: 1000000\nspike_h: 1000000", "less than one frame"),
    ],
)
def test_configurations_that_cannot_be_used(folder: Path, config: str, said: str) -> None:
    (folder / "config.yaml").write_text(config)
    write(folder / "a.dat", FRAME)
    fails("spikecv", folder, said)


def test_another_set_is_not_taken_for_recvidarreal(folder: Path) -> None:
    (folder / "config.yaml").write_text("spike_w: 1000\nspike_h: 1000\nlabeled_data_type: [7]\n")
    write(folder / "classA" / "a.dat", bytes(125_000))
    fails("recvidarreal", folder, "says 1000x1000")


def hostile_npz(shape: tuple[int, ...], name: str = "spk") -> bytes:
    """An archive whose array says that it is as large as `shape`."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": shape})
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr(f"{name}.npy", header.getvalue() + bytes(64))
    return archive.getvalue()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (hostile_npz((10, 10**6, 10**6)), "larger than"),
        (hostile_npz((10**12, 250, 400)), "ends within frame|damaged"),
        (hostile_npz((9, 250, 400), "other"), "no array 'spk'"),
        (hostile_npz((9, 400)), "shape|three axes"),
        (b"PK\3\4 nothing", "no readable array"),
        (b"neither", "neither"),
    ],
)
def test_hostile_archives(folder: Path, content: bytes, said: str) -> None:
    write(folder / "train" / "a.npz", content)
    fails("spike-zoo", folder, said)


def test_cubes_and_masks_that_do_not_fit(folder: Path) -> None:
    np.save(folder / "cube.npy", np.packbits(noise(5), axis=2))
    np.save(folder / "hot_pixels.npy", np.zeros((3, 3), bool))
    fails("wision", folder, "this mask is of 3x3")
    np.save(folder / "hot_pixels.npy", np.zeros((2, 250, 400), bool))
    fails("wision", folder, r"masks are \[rows, columns\]")
    for damaged in (b"\x93NUMPY", b"\x93NUMPY\1\0\4\0{(\n "):
        (folder / "hot_pixels.npy").write_bytes(damaged)
        fails("wision", folder, "hot_pixels.npy: cannot be read")
    (folder / "hot_pixels.npy").unlink()
    np.save(folder / "colour.npy", np.zeros((3, 8, 1, 3), np.uint8))
    fails("wision", folder, "colours in a fourth axis")
    (folder / "colour.npy").unlink()
    cube = (folder / "cube.npy").read_bytes()
    (folder / "cube.npy").write_bytes(cube[:-100])
    fails("wision", folder, "cube.npy: cannot be read")


def test_parts_of_cubes_that_are_missing(folder: Path) -> None:
    write(folder / "binary" / "0.bin", bytes(16_384 + 5))
    fails("wision", folder, "no whole frames of 512x256")


@pytest.mark.parametrize("content", [b"", b"DONE", bytes(32_768), bytes(32_767) + b"DONE", bytes(32_768) + b"FAIL"])
def test_files_of_the_spad_that_are_cut(folder: Path, content: bytes) -> None:
    write(folder / "acq00001" / "RAW00000.bin", content)
    fails("spice-hl3", folder, "the file is|it is cut")


def test_the_stream_of_other_pictures_is_refused(source: Source, folder: Path) -> None:
    LAYOUTS["spikegs-real"][1](folder, source)
    stream = folder / "shop" / "spikes.dat"
    stream.write_bytes(stream.read_bytes()[: 20 * 12_500])
    fails("spikegs-real", folder, "the last picture is of frame")
    (folder / "shop" / "more.dat").write_bytes(FRAME)
    fails("spikegs-real", folder, "2 .dat files and one set of poses")


@pytest.fixture
def locked(folder: Path) -> Path:
    write(folder / "classA" / "a.dat", FRAME * 2)
    write(folder / "classA" / "b.dat", FRAME * 3)
    assert compare(find_kind("recvidarreal").open(folder)).is_new
    return folder


def changes(folder: Path) -> Callable[[], None]:
    compared = compare(find_kind("recvidarreal").open(folder))
    assert not compared.is_new
    return lambda: compared.raise_if_changed(folder)


def test_a_folder_that_has_not_changed_is_sound(locked: Path) -> None:
    changes(locked)()
    write(locked / "classB" / "c.dat", FRAME)
    changes(locked)()
    write(locked / "classB" / "c.dat", b"\1" + FRAME[1:])
    with pytest.raises(SpikedError, match=r"c\.dat has changed"):
        changes(locked)()


@pytest.mark.parametrize("content", [FRAME + b"\1" + FRAME[1:], FRAME])
def test_a_changed_file_is_told(locked: Path, content: bytes) -> None:
    write(locked / "classA" / "a.dat", content)
    with pytest.raises(SpikedError, match=r"a\.dat has changed since .*remove .*lock"):
        changes(locked)()


def test_a_missing_file_is_told(locked: Path) -> None:
    (locked / "classA" / "a.dat").unlink()
    with pytest.raises(SpikedError, match=r"a\.dat is missing since"):
        changes(locked)()


def test_a_lock_that_cannot_be_read_is_told(locked: Path) -> None:
    (locked / "spiked-dataset.lock.json").write_text("{}")
    with pytest.raises(SpikedError, match="remove it to record anew"):
        changes(locked)


def test_a_folder_that_cannot_be_written_is_locked_elsewhere(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(folder / "classA" / "a.dat", FRAME)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    folder.chmod(0o555)
    first = compare(find_kind("recvidarreal").open(folder))
    assert first.is_new and first.path.is_relative_to(tmp_path / "home")
    assert not compare(find_kind("recvidarreal").open(folder)).is_new
    folder.chmod(0o755)
