"""Spikes in arrays of NumPy and HDF5, in photon cubes, and in frames without ends of rows."""

import importlib.util
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import RecordingError
from spiked.recording import Recording, open_recording
from spiked.recording.arrays import open_array, open_bits
from spiked.sensor import BitOrder

FRAMES = 150


def spikes(width: int, height: int = 6) -> NDArray[np.uint8]:
    return np.random.default_rng(width).integers(0, 2, (FRAMES, height, width), np.uint8)


def converted(source: Path, *arguments: object, code: int = 0) -> tuple[Recording | None, str]:
    out = source.parent / "out.dat"
    done = CliRunner().invoke(app, ["convert", str(source), str(out), *map(str, arguments)])
    assert (done.exit_code == 0) == (code == 0), f"{done.output} {done.exception}"
    return (open_recording(out), done.output) if code == 0 else (None, f"{done.output}{done.exception}")


def saved_npz(path: Path, array: NDArray[np.generic]) -> None:
    np.savez_compressed(path, spikes=array, times=np.arange(3.0))


def saved_hdf5(path: Path, array: NDArray[np.generic]) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'spiked[hdf5]'")
    with h5py.File(path, "w") as file:
        file.create_dataset("sequence/spikes", data=array, chunks=(16, *array.shape[1:]), compression="gzip")
        file["times"] = np.arange(3.0)


@pytest.mark.parametrize("dtype", ["uint8", "bool", "int64", "float32"])
@pytest.mark.parametrize(("name", "save"), [("a.npy", np.save), ("a.npz", saved_npz), ("a.h5", saved_hdf5)])
def test_an_array_of_zeros_and_ones_becomes_a_recording(
    tmp_path: Path, name: str, save: Callable[..., None], dtype: str
) -> None:
    frames = spikes(24)
    save(tmp_path / name, frames.astype(dtype))
    made, _ = converted(tmp_path / name, "--rate", 40_000, "--mosaic", "BGGR")
    assert made is not None
    np.testing.assert_array_equal(made.images(0, FRAMES), frames)
    assert (made.sensor.frame_rate_hz, made.sensor.flipped, made.sensor.mosaic) == (40_000, False, "BGGR")


def test_a_photon_cube_has_its_leftmost_pixel_in_the_highest_bit(tmp_path: Path) -> None:
    frames = spikes(512, 4)
    np.save(tmp_path / "cube.npy", np.packbits(frames, axis=2))
    made, _ = converted(tmp_path / "cube.npy", "--rate", 97_700)
    assert made is not None
    np.testing.assert_array_equal(made.images(0, FRAMES), frames)
    np.save(tmp_path / "other.npy", np.packbits(frames, axis=2, bitorder="little"))
    found = open_array(tmp_path / "other.npy", bit_order=BitOrder.LSB)
    np.testing.assert_array_equal(np.concatenate(list(found.blocks())), made.compact(0, FRAMES))


def test_columns_beyond_a_multiple_of_eight_are_left_out_and_said(tmp_path: Path) -> None:
    frames = spikes(30)
    np.save(tmp_path / "odd.npy", frames)
    np.save(tmp_path / "packed.npy", np.packbits(frames, axis=2))
    for name, width in (("odd.npy", ()), ("packed.npy", ("--width", 30))):
        made, said = converted(tmp_path / name, *width)
        assert made is not None and made.sensor.width == 24 and "6 of 30 columns are left out" in said
        np.testing.assert_array_equal(made.images(0, FRAMES), frames[:, :, :24])
        made.path.unlink()
        made.path.with_suffix(".json").unlink()


@pytest.mark.parametrize(("width", "height"), [(30, 4), (346, 5), (13, 7)])
def test_bits_without_ends_of_rows_are_read(tmp_path: Path, width: int, height: int) -> None:
    frames = spikes(width, height)
    np.packbits(frames.reshape(FRAMES, -1), axis=1, bitorder="little").tofile(tmp_path / "vidar.dat")
    made, _ = converted(tmp_path / "vidar.dat", "--from", "bits", "--width", width, "--height", height, "--upright")
    assert made is not None
    np.testing.assert_array_equal(made.images(0, FRAMES), frames[:, :, : width // 8 * 8])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (np.zeros((4, 8), np.uint8), "has the shape"),
        (np.zeros((0, 8, 8), np.uint8), "has the shape"),
        (np.full((4, 8, 8), 0.5), "other values than 0 and 1"),
        (np.full((4, 8, 8), -1), "other values than 0 and 1"),
        (np.full((4, 8, 8), np.nan), "other values than 0 and 1"),
        (np.zeros((4, 8, 8), complex), "elements of complex"),
        (np.zeros((4, 8, 7), np.uint8), "too few"),
    ],
)
def test_what_is_no_array_of_spikes_is_refused(tmp_path: Path, content: NDArray[np.generic], told: str) -> None:
    np.save(tmp_path / "a.npy", content)
    assert told in converted(tmp_path / "a.npy", code=2)[1]


def test_damaged_and_dangerous_files_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "whole.npy", spikes(24))
    whole = (tmp_path / "whole.npy").read_bytes()
    contents = [whole[:100], whole[:2000], b"PK\3\4" + os.urandom(99)]
    if importlib.util.find_spec("h5py"):
        contents.append(b"\x89HDF\r\n\x1a\n" + bytes(9))
    for number, content in enumerate(contents):
        (tmp_path / f"{number}.dat").write_bytes(content)
        assert "readable" in converted(tmp_path / f"{number}.dat", code=2)[1]
    np.save(tmp_path / "pickled.npy", np.array([{"a": 1}], object), allow_pickle=True)
    assert "readable" in converted(tmp_path / "pickled.npy", code=2)[1]


def test_archives_that_unpack_to_the_whole_memory_are_refused(tmp_path: Path) -> None:
    long, many, chunks = tmp_path / "long.npz", tmp_path / "many.npz", tmp_path / "chunks.h5"
    with zipfile.ZipFile(long, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        member.write(b"\x93NUMPY\x02\x00" + (1 << 30).to_bytes(4, "little") + bytes(1 << 20))
    with zipfile.ZipFile(many, "w") as archive:
        for number in range(1001):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(RecordingError, match="1073741824 bytes, more than"):
        open_array(long)
    with pytest.raises(RecordingError, match="1001 arrays, more than 1000"):
        open_array(many)
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'spiked[hdf5]'")
    with h5py.File(chunks, "w") as file:
        file.create_dataset("a", (4000, 1000, 400), "u1", chunks=(3000, 1000, 400), compression="gzip")
    with pytest.raises(RecordingError, match=r"chunks of \[3000, 1000, 400\]"):
        open_array(chunks)


def test_several_arrays_need_a_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", left=spikes(24), right=spikes(32))
    assert "left, right: name one of them" in converted(tmp_path / "two.npz", code=2)[1]
    assert "there is no array 'middle'" in converted(tmp_path / "two.npz", "--array", "middle", code=2)[1]
    made, _ = converted(tmp_path / "two.npz", "--array", "right")
    assert made is not None and made.sensor.width == 32


def test_what_is_stated_has_to_fit(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", spikes(24))
    for arguments, told in (
        (("--width", 32), "24 columns, not 32"),
        (("--height", 9), "6 rows, not 9"),
        (("--to", "array"), "is read and not written"),
        (("--layout", "compact"), "leave it out"),
    ):
        assert told in converted(tmp_path / "a.npy", *arguments, code=2)[1]
    (tmp_path / "b.dat").write_bytes(bytes(10))
    assert "give the width and the height" in converted(tmp_path / "b.dat", "--from", "bits", code=2)[1]
    with pytest.raises(RecordingError, match="less than one frame"):
        open_bits(tmp_path / "b.dat", 100, 100)
    with pytest.raises(RecordingError, match="`spiked convert` reads arrays of spikes"):
        open_recording(tmp_path / "a.npy")
