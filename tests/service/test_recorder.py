"""The recorder's loop over a real ring and a real disk."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from spiked_driver import Chunk, acquire
from spiked_service.workers.roles.recorder import record

from spiked.recording import LIVE, RecordingWriter, open_recording
from spiked.ring import DeviceState, DeviceStatus, EndReason, Policy, RingReader, RingWriter
from spiked.sensor import Sensor

SENSOR = Sensor(400, 250, 20_000.0)


def frames_of(first: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(first)
    return rng.integers(0, 256, (count, SENSOR.frame_bytes), np.uint8)


def recorded(folder: Path, late_blocks: int) -> RecordingWriter:
    """What becomes of a ring in which so many of 64 blocks waited before the recorder came."""
    with (
        RingWriter.create(SENSOR, slots=64) as ring,
        RingReader.attach(ring.name, Policy.PRIORITY, "recorder", 0) as reader,
    ):
        for block in range(late_blocks):
            ring.acquire()[:] = frames_of(8 * block, 8)
            ring.commit(8)
        ring.end(EndReason.FINISHED)
        writer = RecordingWriter(folder / "a.dat", SENSOR, durability=LIVE)
        ended = record(reader, writer, 0, None, threading.Event())
    assert (ended.frames, ended.lost, ended.trouble) == (8 * late_blocks, {}, "")
    recording = open_recording(folder / "a.dat")
    assert all((recording.compact(k, 8) == frames_of(k, 8)).all() for k in range(0, recording.frames, 8))
    return writer


class Steady:
    """A camera that takes a frame each half millisecond, and is seen when the machine gets round to it."""

    def __init__(self) -> None:
        self.sensor = Sensor(64, 48, 2000.0)
        self.frames, self.can_block = None, False
        self.device_status = DeviceStatus(DeviceState.STREAMING)
        self.start_s = 0.0
        self._next = 0

    def open(self) -> None:
        self.start_s = time.monotonic()

    def close(self) -> None:
        pass

    def read_into(self, view: np.ndarray) -> Chunk | None:
        came = int((time.monotonic() - self.start_s) * self.sensor.frame_rate_hz)
        count = min(len(view), came - self._next)
        if not count:
            time.sleep(0.001)
            return None
        self._next += count
        return Chunk(self._next - count, count)


@pytest.fixture
def busy() -> Iterator[None]:
    """Twice as many programs that want a core as there are cores."""
    hogs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    yield
    for hog in hogs:
        hog.kill()
        hog.wait()


def test_a_busy_machine_times_frames_within_a_millisecond(
    tmp_path: Path, busy: None, figure: Callable[[str, object, str], None]
) -> None:
    source, frames = Steady(), 20_000
    with (
        RingWriter.create(source.sensor) as ring,
        RingReader.attach(ring.name, Policy.PRIORITY, "recorder", 0) as reader,
    ):
        acquisition = threading.Thread(
            target=acquire, args=(source, ring, threading.Event()), kwargs={"limit_frames": frames}
        )
        acquisition.start()
        record(reader, RecordingWriter(tmp_path / "a.dat", source.sensor), 0, None, threading.Event())
        acquisition.join()
    recording = open_recording(tmp_path / "a.dat")
    told_ns = recording.unix_ns(np.arange(frames)) - (time.time_ns() - time.monotonic_ns())
    came_ns = 1e9 * source.start_s + np.arange(1, frames + 1) * 1e9 / source.sensor.frame_rate_hz
    error_ms = np.abs(told_ns - came_ns) / 1e6
    figure("time of a frame, busy machine, 99 %", f"{np.percentile(error_ms, 99):.2f} ms", "at most 1 ms")
    assert np.percentile(error_ms, 99) < 1.0, np.percentile(error_ms, [50, 90, 99, 100])
    known = np.array([(pair.frame, pair.unix_ns) for pair in recording.clock])
    rates_hz = 1e9 * np.diff(known[:, 0]) / np.diff(known[:, 1])
    assert len(known) >= 6
    np.testing.assert_allclose(rates_hz, 2000.0, rtol=0.005)


def test_a_disk_that_is_behind_is_helped_by_the_page_cache(disk: Path) -> None:
    (disk / "punctual").mkdir()
    (disk / "late").mkdir()
    punctual = recorded(disk / "punctual", 12)
    assert punctual.bytes - punctual.direct_bytes < 2 * 4096
    late = recorded(disk / "late", 48)
    # Behind the first 16 blocks, which are written at once, more than a quarter of the ring waited.
    assert late.bytes - late.direct_bytes == pytest.approx(16 * 8 * SENSOR.frame_bytes, abs=3 * 4096)
