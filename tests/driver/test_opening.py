"""The first frames of a stream may be old: they are discarded, and the capture counts from behind them."""

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from spiked_driver.acquisition import SlotPacker
from spiked_driver.framing import USB_COMPACT_BYTES, USB_FRAME_BYTES, UsbFraming, encode_usb
from spiked_driver.opening import OpeningFilter
from spiked_driver.source import Chunk

from spiked.ring import Gap, LossCause, RingWriter
from spiked.sensor import Sensor

REAL = Path(__file__).parents[3] / "shared" / "wire" / "sps10_002_ep82_contiguous.bin"
RATE = 2000.0
OPENING = 100
"""Frames of the opening at that rate."""


def numbered(first: int, count: int, **counters: int) -> bytes:
    """Wire bytes of frames whose first 8 bytes are their number."""
    frames = np.zeros((count, USB_COMPACT_BYTES), np.uint8)
    frames[:, :8] = np.arange(first, first + count, dtype="<i8").view(np.uint8).reshape(-1, 8)
    return encode_usb(frames, first=first, **counters).tobytes()


def read(wire: bytes, *, piece: int = 40_000) -> tuple[list[int], list[Gap], list[tuple[int, int]]]:
    """Numbers of the frames, gaps, and what was told; indices are checked to be without a hole."""
    told: list[tuple[int, int]] = []
    framing = UsbFraming()
    opening = OpeningFilter(framing, RATE, lambda count, older: told.append((count, older)))
    numbers: list[int] = []
    gaps: list[Gap] = []
    view = np.zeros((7, USB_COMPACT_BYTES), np.uint8)
    next_index = 0
    for start, stop in pairwise([*range(0, len(wire), piece), len(wire)]):
        framing.feed(wire[start:stop])
        while item := opening.read_into(view):
            assert item.first == next_index
            if isinstance(item, Chunk):
                numbers += view[: item.frames, :8].copy().view("<i8")[:, 0].tolist()
                next_index += item.frames
            else:
                gaps.append(item)
                next_index += item.count
    return numbers, gaps, told


def test_without_a_jump_every_frame_is_delivered_without_a_warning() -> None:
    assert read(numbered(5, 300)) == (list(range(5, 305)), [], [])


def test_frames_that_wait_behind_the_opening_are_not_lost_again_when_an_acquisition_restarts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It died 130 frames ago; of these the opening held 100, which come after the gap."""
    died_s = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: died_s + 130 / RATE)
    framing = UsbFraming()
    opening = OpeningFilter(framing, RATE, lambda count, older: None)
    framing.feed(numbered(0, OPENING + 1))
    with RingWriter.create(Sensor(400, 250, RATE), slots=64, block_frames=8) as writer:
        packer = SlotPacker(writer, None, died_s)
        while isinstance(item := opening.read_into(packer.view()), Chunk):
            packer.add(item)
        packer.flush()
        status = writer.status().writer
    assert status.committed >= OPENING
    assert abs(status.next_frame - 130) <= 16 and sum(status.lost.values()) == status.next_frame - status.committed


@pytest.mark.parametrize("old", [1, 3, OPENING - 1])
def test_frames_before_a_jump_of_the_opening_are_old(old: int) -> None:
    numbers, gaps, told = read(numbered(0, old) + numbered(241_232, 300))
    assert numbers == list(range(241_232, 241_532))
    assert gaps == []
    assert told == [(old, 241_232 - old + 1)]


def test_the_last_jump_counts_where_old_frames_are_of_several_times() -> None:
    numbers, gaps, told = read(numbered(0, 2) + numbered(500, 5) + numbered(9000, 300))
    assert (numbers[0], len(numbers), gaps) == (9000, 300, [])
    assert told == [(7, 9000 - 504)]


def test_a_loss_so_early_is_taken_for_old_frames_and_a_later_one_is_a_loss() -> None:
    numbers, gaps, told = read(numbered(0, 40) + numbered(42, OPENING) + numbered(50 + OPENING, 20))
    assert numbers[:2] == [42, 43]
    assert told == [(40, 3)]
    assert gaps == [Gap(OPENING, 8, LossCause.DEVICE)]


def test_frames_of_a_stream_that_is_shorter_than_the_opening_wait() -> None:
    assert read(numbered(0, OPENING - 1))[0] == []


@pytest.mark.skipif(not REAL.is_file(), reason="the real bytes in ../shared/wire are not here")
def test_the_real_bytes_begin_with_one_old_frame() -> None:
    real = REAL.read_bytes()
    later = 4 + USB_FRAME_BYTES  # the header that is 241,232 frames later, and what there is of its frame
    nbytes, lines = np.frombuffer(real[later + 8 : later + 16], "<u4").tolist()
    numbers, gaps, told = read(real[:later] + numbered(0, 300, lines=lines, nbytes=nbytes))
    assert numbers == list(range(300))
    assert gaps == []
    assert told == [(1, 241_232)]
