"""The recorder's loop over a real ring and a real disk."""

import threading
from pathlib import Path

import numpy as np
import pytest
from spiked_service.roles.recorder import record

from spiked.recording import LIVE, RecordingWriter, open_recording
from spiked.ring import EndReason, Policy, RingReader, RingWriter
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


def test_a_disk_that_is_behind_is_helped_by_the_page_cache(disk: Path) -> None:
    (disk / "punctual").mkdir()
    (disk / "late").mkdir()
    punctual = recorded(disk / "punctual", 12)
    assert punctual.bytes - punctual._files.frames.direct_bytes < 2 * 4096
    late = recorded(disk / "late", 48)
    # Behind the first 16 blocks, which are written at once, more than a quarter of the ring waited.
    assert late.bytes - late._files.frames.direct_bytes == pytest.approx(16 * 8 * SENSOR.frame_bytes, abs=3 * 4096)
