"""Recordings on disk: writing against a plain write of the same bytes, decoding against common implementations."""

import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.measurement import Measurement, repeated
from spiked.recording import LIVE, RecordingWriter, open_recording
from spiked.sensor import Sensor

_BATCH = 128  # frames a write
_PLAIN_BYTES = 1 << 20
"""Bytes of a plain write, for comparison."""


def rows(folder: Path | None = None, *, megabytes: int = 256) -> list[Measurement]:
    """Both comparisons, in `folder` or in the folder for temporary files."""
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        return [_writing(Path(scratch), megabytes), *_decoding(Path(scratch))]


def _writing(folder: Path, megabytes: int) -> Measurement:
    sensor = Sensor(400, 250, 20_000.0)
    batch = np.random.default_rng(0).integers(0, 256, (_BATCH, sensor.frame_bytes), np.uint8)
    batches = max(1, (megabytes << 20) // batch.nbytes)
    number = 0

    def plain() -> None:
        large = np.resize(batch.ravel(), _PLAIN_BYTES).tobytes()
        path = folder / "plain"
        with path.open("wb", buffering=0) as file:
            left = batches * batch.nbytes
            while left > 0:
                left -= file.write(large[: min(left, len(large))])
            os.fsync(file.fileno())
        path.unlink()

    def ours() -> None:
        nonlocal number
        number += 1
        path = folder / f"ours{number}.dat"
        writer = RecordingWriter(path, sensor, durability=LIVE)
        for _ in range(batches):
            writer.append(batch)
        writer.close()
        path.unlink()

    # In turn, since a disk is not the same from one minute to the next.
    pairs = [(repeated(plain, 2), repeated(ours, 2)) for _ in range(3)]
    ratio = float(np.median([a.median_s / b.median_s for a, b in pairs]))
    speed = batches * batch.nbytes / min(b.best_s for _, b in pairs)
    against = "of a plain write's speed, both synced, ours with CRC"
    return Measurement("record to disk, 400x250", speed * 1e-6, "MB/s", ratio, against, ">= 0.9")


def _decoding(folder: Path) -> list[Measurement]:
    sensor = Sensor(400, 250, 20_000.0)
    bits = np.random.default_rng(1).integers(0, 256, (2, 400, sensor.frame_bytes), np.uint8)
    path = folder / "decode.dat"
    with RecordingWriter(path, sensor) as writer:
        writer.append(bits[0] & bits[1])
    recording = open_recording(path)
    expected = recording.images(0, 20)
    found = []
    for name, usual in (("whole file at once", by_masks), ("frame by frame", by_frames)):
        if not (usual(path, 20) == expected).all():
            raise AssertionError(f"the benchmark's own decoder is wrong: {name}")
        ours = repeated(lambda: _by_us(path), 5)
        theirs = repeated(lambda usual=usual: usual(path, 400), 2)  # type: ignore[misc]
        found.append(
            Measurement(
                f"decode .dat to images, 400x250, {name}",
                ours.median_s / 400 * 1e6,
                "us/frame",
                theirs.median_s / ours.median_s,
                "times as fast as masks over NumPy",
                ">= 20",
                ours.spread,
            )
        )
    return found


def _by_us(path: Path, piece: int = 40) -> None:
    recording = open_recording(path)
    out = np.empty((piece, recording.sensor.height, recording.sensor.width), np.uint8)
    for first in range(0, recording.frames, piece):
        recording.images(first, piece, out=out)


def by_masks(path: Path, frames: int, width: int = 400, height: int = 250) -> NDArray[np.uint8]:
    """Common decoder, for comparison: for each frame, one mask per bit over all bytes."""
    data = np.frombuffer(path.read_bytes(), np.uint8)
    size = width * height // 8
    out = np.zeros((frames, height, width), np.uint8)
    for k in range(frames):
        frame = data[k * size : (k + 1) * size].astype(np.int64)
        image = np.zeros((size, 8), np.uint8)
        for bit in range(8):
            image[:, bit] = (np.bitwise_and(frame, 1 << bit) == 1 << bit).astype(np.uint8)
        out[k] = np.flipud(image.reshape(height, width))
    return out


def by_frames(path: Path, frames: int, width: int = 400, height: int = 250) -> NDArray[np.uint8]:
    """Common decoder, for comparison: for each frame, byte and mask of every pixel are looked up."""
    data = np.frombuffer(path.read_bytes(), np.uint8)
    size = width * height // 8
    pixel = np.arange(width * height).reshape(height, width)
    mask = np.left_shift(1, np.bitwise_and(pixel, 7))
    place = pixel // 8
    out = np.zeros((frames, height, width), np.uint8)
    for k in range(frames):
        frame = data[k * size : (k + 1) * size]
        out[k] = np.flipud(np.bitwise_and(frame[place], mask) == mask)
    return out
