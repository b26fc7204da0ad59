"""What must be true of wire bytes, by the facts of the camera and nothing of spiked."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from virtual_camera.stream import FRAME_BYTES, ROWS


def frames_of(path: Path) -> NDArray[np.uint8]:
    """The whole frames of a wire file that begins with one, uint8 [n, 13016]."""
    data = np.fromfile(path, np.uint8)
    return data[: len(data) // FRAME_BYTES * FRAME_BYTES].reshape(-1, FRAME_BYTES)


def lines_of(frames: NDArray[np.uint8]) -> list[int]:
    """The line counters of frames, in frames."""
    return [int(value) // ROWS for value in np.ascontiguousarray(frames[:, 12:16]).view("<u4")[:, 0]]


def assert_sent(frames: NDArray[np.uint8], pictures: Path, start: int) -> None:
    """The frames must be the pictures in order, with headers that count from `start` on and stamps from 0 on."""
    sent = np.fromfile(pictures, np.uint8).reshape(-1, ROWS, 50)
    for index, frame in enumerate(frames):
        magic, word1, nbytes, lines = np.frombuffer(frame[:16].tobytes(), "<u4").tolist()
        assert (magic, word1) == (0x63606300, 0x00100021)
        assert lines == (start + ROWS * index) & 0xFFFFFFFF
        assert nbytes == 50 * (start + ROWS * index) & 0xFFFFFFFF
        rows = frame[16:].reshape(ROWS, 52).copy()
        assert rows[:, 50:].tobytes() == np.arange(ROWS, dtype="<u2").tobytes()
        assert rows[0, :8].tobytes() == index.to_bytes(8, "little")
        rows[0, :8] = sent[index % len(sent), 0, :8]
        np.testing.assert_array_equal(rows[:, :50], sent[index % len(sent)])
