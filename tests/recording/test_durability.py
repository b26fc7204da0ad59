"""What a recording is worth after kills, full disks and bad bytes."""

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recording import (
    LIVE,
    Durability,
    Gap,
    RecordingWriter,
    Sync,
    durability,
    index_path,
    open_recording,
    read_index,
    recover,
    sidecar_path,
    verify,
)
from spiked.recording.durability import Allocator
from spiked.recording.index import ENTRY_BYTES
from spiked.sensor import Layout, Sensor

from ..small_disk import small_disk

SENSOR = Sensor(64, 16, 1000.0)
INDEXED = Durability(index=True)


def frames(first: int, count: int, sensor: Sensor = SENSOR) -> NDArray[np.uint8]:
    """Frames that can be told apart: each is random by its number."""
    size = sensor.compact().frame_bytes
    return np.stack([np.random.default_rng(first + k).integers(0, 256, size, np.uint8) for k in range(count)])


def written(folder: Path, blocks: int = 10, durability: Durability = INDEXED) -> RecordingWriter:
    """A writer that has written blocks of 8 frames, with a loss of 3 frames before the sixth, and has not closed."""
    writer = RecordingWriter(folder / "a.dat", SENSOR, durability=durability)
    for number in range(blocks):
        if number == 5:
            writer.gap(writer.next_frame, 3, "usb")
        writer.append(frames(writer.next_frame, 8))
    writer.clock_pair(writer.next_frame, 123)
    return writer


def assert_holds(path: Path, count: int) -> None:
    """The recording holds the first so many frames of `written`, each one in its place."""
    recording = open_recording(path)
    assert recording.frames == count
    for k in range(count):
        np.testing.assert_array_equal(recording.compact(k, 1), frames(recording.capture_index(k), 1))


def test_a_closed_recording_has_an_index_that_agrees(tmp_path: Path) -> None:
    written(tmp_path).close()
    index = read_index(index_path(tmp_path / "a.dat"))
    assert (index.frames, index.damaged_bytes) == (80, 0)
    assert index.gaps() == (Gap(first=40, count=3, cause="usb"),)
    assert index.clock()[0].unix_ns == 123
    assert len(index.unsynced) == 0
    assert_holds(tmp_path / "a.dat", 80)
    assert verify(tmp_path / "a.dat").reasons == ("3 frames were lost in 1 gaps",)


def test_cut_at_any_byte_the_whole_blocks_remain(tmp_path: Path) -> None:
    writer = written(tmp_path, blocks=6)
    del writer
    data, index = (tmp_path / "a.dat").read_bytes(), index_path(tmp_path / "a.dat").read_bytes()
    block = 8 * SENSOR.frame_bytes
    rng = np.random.default_rng(0)
    cuts = [(int(rng.integers(len(data))), len(index)) for _ in range(20)]
    cuts += [(len(data), int(rng.integers(32, len(index)))) for _ in range(20)]
    cuts += [(k * block, len(index)) for k in range(7)]
    for number, (data_bytes, index_bytes) in enumerate(cuts):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "a.dat").write_bytes(data[:data_bytes])
        (folder / "a.index").write_bytes(index[:index_bytes])
        shutil.copy(sidecar_path(tmp_path / "a.dat"), folder)
        told = (index_bytes - 32) // ENTRY_BYTES
        told -= told > 5  # the loss
        expected = min(data_bytes // block, told, 6)
        recovered = recover(folder / "a.dat", finish=True)
        assert recovered.frames == 8 * expected
        assert not recovered.was_finished
        if expected:
            assert_holds(folder / "a.dat", 8 * expected)
            assert "damaged" not in str(verify(folder / "a.dat").reasons)
        assert recover(folder / "a.dat", finish=True).was_finished


@pytest.mark.parametrize("sync", [Sync.SECOND, Sync.BLOCK, Sync.CLOSE])
def test_a_killed_writer_leaves_whole_blocks(tmp_path: Path, sync: Sync) -> None:
    code = (
        "import sys, numpy as np\n"
        "from spiked.recording import RecordingWriter, Durability, LIVE\n"
        "from spiked.sensor import Sensor\n"
        "from dataclasses import replace\n"
        f"w = RecordingWriter(sys.argv[1], Sensor(64, 16, 1000.0), durability=replace(LIVE, sync='{sync}'))\n"
        "while True:\n"
        "    w.append(np.full((8, 128), w.frames // 8 % 251, np.uint8))\n"
        "    if w.frames == 80: print('going', flush=True)\n"
    )
    path = tmp_path / "a.dat"
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline()
        time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.wait()
    stored = path.stat().st_size // SENSOR.frame_bytes
    before = open_recording(path)
    assert "not finished" in before.warnings[-1]
    recovered = recover(path, finish=True)
    assert recovered.frames >= max(80, stored - 8)
    recording = open_recording(path)
    values = recording.data.reshape(recording.frames // 8, -1)
    assert (values == (np.arange(len(values)) % 251)[:, None]).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.dat", "a.index", "a.json"]
    assert path.stat().st_blocks * 512 < path.stat().st_size + (1 << 20)


def test_an_unsynced_block_with_a_wrong_byte_is_cut_off_and_a_synced_one_is_told(tmp_path: Path) -> None:
    writer = written(tmp_path)
    del writer
    path = tmp_path / "a.dat"
    content = bytearray(path.read_bytes())
    content[7 * 8 * SENSOR.frame_bytes + 5] ^= 1
    path.write_bytes(content)
    assert recover(path, finish=True).frames == 7 * 8
    assert_holds(path, 56)

    content = bytearray(path.read_bytes())
    content[8 * SENSOR.frame_bytes] ^= 1
    path.write_bytes(content)
    assert "8 frames differ from what was written, the first at frame 8" in verify(path).reasons


def test_recovery_invents_no_frames(tmp_path: Path) -> None:
    """A copy whose file was taken before its index, or a disk that lost what it had."""
    written(tmp_path).close()
    file = tmp_path / "a.dat"
    sidecar = json.loads(sidecar_path(file).read_text())
    sidecar_path(file).write_text(json.dumps({**sidecar, "frames": None, "gaps": [], "clock": []}))
    os.truncate(file, 70 * SENSOR.frame_bytes + 5)
    found = recover(file, finish=True)
    assert (found.frames, found.missing_frames, file.stat().st_size) == (64, 16, 64 * SENSOR.frame_bytes)
    assert_holds(file, 64)
    assert found.sidecar.gaps == (Gap(first=40, count=3, cause="usb"),)


def test_the_gaps_of_an_unfinished_recording_are_those_of_its_index(tmp_path: Path) -> None:
    writer = written(tmp_path)
    recording = open_recording(tmp_path / "a.dat")
    assert recording.gaps == (Gap(first=40, count=3, cause="usb"),) and recording.clock[0].unix_ns == 123
    assert recording.capture_index(40) == 43 and "was not finished" in recording.warnings[0]
    writer.close()


def test_a_resumed_recording_is_as_one_that_was_never_interrupted(tmp_path: Path) -> None:
    first = written(tmp_path, blocks=7)
    del first
    second = RecordingWriter.resume(tmp_path / "a.dat", durability=INDEXED)
    assert (second.frames, second.next_frame) == (56, 59)
    second.gap(59, 2, "disk")
    second.append(frames(61, 8))
    second.close()
    assert_holds(tmp_path / "a.dat", 64)
    assert [gap.cause for gap in open_recording(tmp_path / "a.dat").gaps] == ["usb", "disk"]
    assert read_index(index_path(tmp_path / "a.dat")).frames == 64
    assert "as they were written" not in str(verify(tmp_path / "a.dat").reasons)


def test_stored_layouts_are_summed_as_stored(tmp_path: Path) -> None:
    tagged = replace(SENSOR, layout=Layout.ROW_TAGGED)
    with RecordingWriter(tmp_path / "a.dat", tagged, durability=INDEXED) as writer:
        writer.append(frames(0, 8))
    assert "as they were written" not in str(verify(tmp_path / "a.dat").reasons)


def test_a_gap_out_of_order_is_refused_with_an_index(tmp_path: Path) -> None:
    writer = written(tmp_path)
    with pytest.raises(ValueError, match="was next"):
        writer.gap(3, 1, "usb")


def test_an_index_of_another_geometry_is_told(tmp_path: Path) -> None:
    written(tmp_path).close()
    path = tmp_path / "a.dat"
    sidecar_path(path).write_text(sidecar_path(path).read_text().replace('"width": 64', '"width": 32'))
    sidecar_path(path).write_text(sidecar_path(path).read_text().replace('"frames": 80', '"frames": null'))
    with pytest.raises(RecordingError, match="belongs to another recording"):
        recover(path)


@pytest.fixture(name="small_disk")
def make_small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MiB."""
    with small_disk(tmp_path / "disk", 4) as place:
        yield place


def test_a_full_disk_leaves_a_whole_recording_and_room_for_others(small_disk: Path) -> None:
    sensor = Sensor(400, 250, 20_000.0)
    writer = RecordingWriter(small_disk / "a.dat", sensor, durability=LIVE)
    block = np.random.default_rng(0).integers(0, 256, (8, sensor.frame_bytes), np.uint8)
    with pytest.raises(RecordingError, match=r"the disk is full.* frames are safe"):
        for _ in range(100):
            writer.append(block)
    writer.close()
    recording = open_recording(small_disk / "a.dat")
    assert recording.frames == writer.frames > 200
    assert recording.warnings == ()
    assert verify(small_disk / "a.dat").verdict == "good"
    free = os.statvfs(small_disk)
    assert free.f_bavail * free.f_frsize > 4 * 2**20 // 25


def test_a_disk_filled_by_others_cannot_keep_the_sidecar_from_being_finished(small_disk: Path) -> None:
    writer = RecordingWriter(small_disk / "a.dat", SENSOR, durability=replace(LIVE, preallocate_bytes=0))
    writer.append(frames(0, 8))
    with pytest.raises(OSError, match="No space"), (small_disk / "others").open("wb", buffering=0) as file:
        while file.write(bytes(4096)) == 4096:
            pass
        file.write(bytes(4096))
    with pytest.raises(RecordingError, match="frames are safe"):
        for _ in range(8):
            writer.append(frames(writer.frames, 8))
    writer.close()
    assert_holds(small_disk / "a.dat", writer.frames)


def test_a_limit_on_the_size_of_files_counts_as_a_full_disk(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    writer = RecordingWriter(tmp_path / "a.dat", SENSOR, durability=replace(INDEXED, preallocate_bytes=1 << 20))
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
        with pytest.raises(RecordingError, match="frames are safe"):
            for number in range(100):
                writer.append(frames(8 * number, 8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    writer.close()
    assert_holds(tmp_path / "a.dat", writer.frames)
    assert writer.frames == 8 * (50_000 // (8 * SENSOR.frame_bytes))


def test_space_taken_in_advance_is_given_back(tmp_path: Path) -> None:
    writer = written(tmp_path, durability=LIVE)
    ahead = (tmp_path / "a.dat").stat()
    writer.close()
    after = (tmp_path / "a.dat").stat()
    assert ahead.st_size == after.st_size == 80 * SENSOR.frame_bytes
    assert ahead.st_blocks * 512 > 32 << 20
    assert after.st_blocks * 512 <= 80 * SENSOR.frame_bytes + 4096


def test_an_error_of_the_last_sync_in_the_background_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel tells it once: a later sync of the same file succeeds."""
    failed, real = threading.Event(), os.fdatasync

    def sync(file: int) -> None:
        if not failed.is_set():
            failed.set()
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        real(file)

    monkeypatch.setattr(os, "fdatasync", sync)
    writer = RecordingWriter(tmp_path / "rec.dat", SENSOR, durability=Durability(index=True, sync=Sync.SECOND))
    writer.append(np.zeros((8, SENSOR.frame_bytes), np.uint8))
    assert failed.wait(10)
    with pytest.raises(RecordingError, match="cannot be finished"):
        writer.close()


def test_space_is_taken_again_after_a_file_was_cut(tmp_path: Path) -> None:
    with (tmp_path / "rec.dat").open("wb") as file:
        allocator = Allocator(file.fileno(), Durability(preallocate_bytes=1 << 20), 0)
        allocator.before(4096)
        if os.fstat(file.fileno()).st_blocks * 512 < 1 << 20:
            pytest.skip("this file system does not allocate ahead")
        file.truncate(1)  # frees what is allocated behind it
        file.truncate(0)
        allocator.cut(0)
        allocator.before(4096)
        assert os.fstat(file.fileno()).st_blocks * 512 >= 1 << 20


def test_a_read_only_file_system_is_told(small_disk: Path) -> None:
    writer = RecordingWriter(small_disk / "a.dat", SENSOR, durability=INDEXED)
    writer.append(frames(0, 8))
    writer.close()
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(RecordingError, match="Read-only"):
        RecordingWriter(small_disk / "b.dat", SENSOR)


def test_the_disk_begins_before_a_sync_is_due(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[tuple[int, int]] = []
    real = durability.begin_write

    def watched(file: int, offset: int, size: int) -> None:
        begun.append((offset, size))
        real(file, offset, size)

    monkeypatch.setattr(durability, "begin_write", watched)
    monkeypatch.setattr(durability, "EARLY_BYTES", 4096)
    monkeypatch.setattr(durability, "SYNC_PERIOD_S", 600.0)
    with RecordingWriter(tmp_path / "a.dat", SENSOR, durability=LIVE) as writer:
        for _ in range(3):
            writer.append(frames(writer.next_frame, 40))
            deadline_s = time.monotonic() + 20
            while sum(size for _, size in begun) < writer.bytes:
                assert time.monotonic() < deadline_s, begun
                time.sleep(0.001)
    ends = [0, *(offset + size for offset, size in begun)]
    assert [offset for offset, _ in begun] == ends[:-1]  # all of it, in order, nothing twice
    assert ends[-1] == 120 * SENSOR.frame_bytes
