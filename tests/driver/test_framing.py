"""Whatever happens to the bytes of the USB camera, a frame that comes out is one that was sent, with its index."""

from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from spiked_driver.framing import USB_COMPACT_BYTES, USB_FRAME_BYTES, Framing, UsbFraming, benchmark_usb, encode_usb
from spiked_driver.source import Chunk

from spiked.ring import Gap, LossCause

REAL = Path(__file__).parents[3] / "shared" / "wire" / "sps10_002_ep82_contiguous.bin"
SENT = 12
FRAMES = np.random.default_rng(7).integers(0, 256, (SENT, USB_COMPACT_BYTES), np.uint8)
WRAP = (1 << 32) - 250 * (SENT // 2) - 100
"""A line counter that wraps in the middle of FRAMES."""


@dataclass
class Taken:
    frames: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)


def take(framing: Framing, wire: bytes, cuts: list[int], frame_bytes: int = USB_COMPACT_BYTES) -> Taken:
    """Feed the bytes in pieces that end at `cuts`, and account for every index."""
    taken, view, expected = Taken(), np.zeros((3, frame_bytes), np.uint8), 0
    bounds = sorted({0, len(wire), *(cut for cut in cuts if cut < len(wire))})
    pieces = [wire[start:stop] for start, stop in pairwise(bounds)]
    for piece in [*pieces, None]:
        if piece is None:
            framing.finish()
        else:
            framing.feed(piece)
        while item := framing.read_into(view):
            assert item.first == expected
            if isinstance(item, Gap):
                taken.gaps.append(item)
                expected += item.count
            else:
                taken.frames |= {item.first + k: view[k].copy() for k in range(item.frames)}
                expected += item.frames
    counters = framing.counters
    assert counters.received == len(taken.frames)
    assert counters.lost == sum(gap.count for gap in taken.gaps)
    assert counters.received + counters.lost == framing.next_index == expected
    assert counters.bytes == len(wire)
    return taken


def sent_index(frame: NDArray[np.uint8], sent: NDArray[np.uint8]) -> int:
    """Which frame it was, for frames that differ in most pixels; damaged pixels are few."""
    wrong = np.bitwise_count(sent ^ frame).sum(axis=1)
    best = int(wrong.argmin())
    assert wrong[best] < 0.01 * 8 * frame.size, "a frame that was never sent"
    return best


class Kind(StrEnum):
    FLIP = "flip"
    HEADER = "header"
    DROP = "drop"
    JUNK = "junk"
    REPEAT = "repeat"
    CUT = "cut"


@dataclass(frozen=True)
class Damage:
    """One thing that befalls a byte stream.

    Losing or repeating exactly a frame's bytes from the middle of one frame to the middle of the next cannot be seen on
    this wire, which has no checksum; such losses are only made between frames. Transfers are no multiple of a frame.
    """

    kind: Kind
    place: float
    span: int

    def apply(self, data: bytearray, frame_bytes: int) -> None:
        at = int(self.place * len(data))
        match self.kind:
            case Kind.FLIP:
                data[at] ^= 1 + self.span % 255
            case Kind.HEADER:
                data[at - at % frame_bytes + self.span % 16] ^= 1 + self.span % 255
            case Kind.DROP:
                del data[at : at + self.span]
            case Kind.JUNK:
                data[at:at] = np.random.default_rng(self.span).bytes(self.span)
            case Kind.REPEAT:
                data[at:at] = data[max(0, at - self.span) : at]
            case Kind.CUT:
                del data[max(at, len(data) // 2) :]


DAMAGE = st.builds(Damage, st.sampled_from(Kind), st.floats(0, 1, exclude_max=True), st.integers(1, 6000))


def damaged(data: bytes, damages: list[Damage], frame_bytes: int) -> bytes:
    spoilt = bytearray(data)
    for damage in damages:
        if len(spoilt) > frame_bytes:
            damage.apply(spoilt, frame_bytes)
    return bytes(spoilt)


@settings(max_examples=150, deadline=None)
@given(
    order=st.lists(st.integers(0, SENT - 1), min_size=2, max_size=SENT).map(sorted),
    damages=st.lists(DAMAGE, max_size=5),
    cuts=st.lists(st.integers(1, SENT * USB_FRAME_BYTES), max_size=8),
)
def test_no_damage_makes_a_wrong_frame_or_a_wrong_index(
    order: list[int], damages: list[Damage], cuts: list[int]
) -> None:
    wire = encode_usb(FRAMES, lines=WRAP, nbytes=(1 << 32) - 20_000)[order].tobytes()
    taken = take(UsbFraming(), damaged(wire, damages, USB_FRAME_BYTES), cuts)
    offsets = {sent_index(frame, FRAMES) - index for index, frame in taken.frames.items()}
    assert len(offsets) <= 1
    assert all(offset >= 0 for offset in offsets)


@settings(max_examples=30, deadline=None)
@given(order=st.lists(st.integers(0, SENT - 1), min_size=2, max_size=SENT, unique=True).map(sorted))
def test_every_frame_that_arrives_whole_is_delivered(order: list[int]) -> None:
    taken = take(UsbFraming(), encode_usb(FRAMES, lines=WRAP)[order].tobytes(), [])
    assert [index + order[0] for index in taken.frames] == order


@pytest.mark.parametrize("step", [1, 3, 4, 13_015, 13_016, 13_017, 40_000])
def test_chunks_of_any_size_give_the_same_frames(step: int) -> None:
    wire = encode_usb(FRAMES[:3]).tobytes()
    taken = take(UsbFraming(), wire, list(range(step, len(wire), step)))
    np.testing.assert_array_equal(np.stack(list(taken.frames.values())), FRAMES[:3])
    assert not taken.gaps


def test_counters_may_wrap_within_a_gap() -> None:
    wire = encode_usb(FRAMES, lines=WRAP, nbytes=17)
    kept = [0, 1, 2, 9, 10, 11]
    taken = take(UsbFraming(), wire[kept].tobytes(), [])
    assert taken.gaps == [Gap(3, 6, LossCause.DEVICE)]
    assert list(taken.frames) == kept
    for index, frame in taken.frames.items():
        np.testing.assert_array_equal(frame, FRAMES[index])


def test_losses_of_the_camera_and_of_the_host_have_different_causes() -> None:
    wire = encode_usb(FRAMES)
    spoilt = wire[4].copy()
    spoilt[5000:5400] = 0xFF
    stream = [*wire[:2], *wire[3:4], spoilt, *wire[5:]]
    taken = take(UsbFraming(), np.concatenate(stream).tobytes(), [])
    assert taken.gaps == [Gap(2, 1, LossCause.DEVICE), Gap(4, 1, LossCause.USB)]


def test_a_marked_loss_is_the_hosts_though_no_byte_is_amiss() -> None:
    framing, wire, view = UsbFraming(), encode_usb(FRAMES), np.zeros((SENT, USB_COMPACT_BYTES), np.uint8)
    framing.feed(wire[:3].reshape(-1))
    framing.read_into(view)
    framing.mark_loss()
    framing.feed(wire[6:].reshape(-1))
    assert framing.read_into(view) == Gap(3, 3, LossCause.USB)


def test_repeated_and_late_frames_are_dropped_and_counted() -> None:
    wire = encode_usb(FRAMES)
    framing = UsbFraming()
    taken = take(framing, wire[[0, 1, 1, 2, 4, 3, 5, 6]].tobytes(), [])
    assert framing.counters.duplicates == 2
    assert list(taken.frames) == [0, 1, 2, 4, 5, 6]
    assert taken.gaps == [Gap(3, 1, LossCause.DEVICE)]
    assert framing.counters.skipped_bytes == 0


def test_start_up_junk_is_skipped_even_with_a_stale_header() -> None:
    wire = encode_usb(FRAMES)
    junk = wire[0, :16].tobytes() + bytes(100) + wire[1, :4].tobytes()
    framing = UsbFraming()
    taken = take(framing, junk + wire[3:].tobytes(), [50, 119])
    assert framing.counters.skipped_bytes == len(junk)
    np.testing.assert_array_equal(taken.frames[0], FRAMES[3])
    assert not taken.gaps


def test_a_camera_that_counts_anew_goes_on_after_a_gap() -> None:
    before, after = encode_usb(FRAMES[:4], lines=1000), encode_usb(FRAMES[4:], lines=77, nbytes=5)
    framing = UsbFraming()
    taken = take(framing, before.tobytes() + after.tobytes(), [])
    assert framing.counters.restarts == 1
    assert taken.gaps == [Gap(4, 1, LossCause.DEVICE)]
    np.testing.assert_array_equal(taken.frames[5], FRAMES[4])


def resumed(
    lost: int, tolerance: int, wire: NDArray[np.uint8], cause: LossCause = LossCause.DEVICE
) -> tuple[Gap, Chunk]:
    """What follows two and a half frames of FRAMES after a break: the gap and the frames."""
    framing, view = UsbFraming(), np.zeros((SENT, USB_COMPACT_BYTES), np.uint8)
    framing.feed(encode_usb(FRAMES[:3]).reshape(-1)[:-100])
    assert framing.read_into(view) == Chunk(0, 2)
    framing.resume(1, tolerance, LossCause.USB)
    framing.resume(lost, tolerance, cause)
    framing.feed(wire.reshape(-1))
    gap, chunk = framing.read_into(view), framing.read_into(view)
    assert isinstance(gap, Gap)
    assert isinstance(chunk, Chunk)
    assert gap.first + gap.count == chunk.first
    np.testing.assert_array_equal(view[: chunk.frames], FRAMES[-chunk.frames - 1 : -1])
    assert framing.counters.skipped_bytes == USB_FRAME_BYTES - 100
    return gap, chunk


def test_after_a_break_the_cameras_own_count_is_taken_if_it_runs_on() -> None:
    wire = encode_usb(FRAMES[6:], first=506)[:-1]
    wire = np.concatenate([wire.reshape(-1), encode_usb(FRAMES[-1:], first=511).reshape(-1)[:16]])
    assert resumed(500, 20, wire)[0] == Gap(2, 504, LossCause.DEVICE)
    assert resumed(500, 20, wire, LossCause.USB)[0] == Gap(2, 504, LossCause.USB)


@pytest.mark.parametrize(("first", "lines"), [(506, 77), (900, 0), (0, 0)], ids=["anew", "too far", "from zero"])
def test_after_a_break_a_camera_that_counts_anew_has_lost_what_the_clock_says(first: int, lines: int) -> None:
    wire = encode_usb(FRAMES[6:], first=first, lines=lines).reshape(-1)[: 5 * USB_FRAME_BYTES + 16]
    assert resumed(500, 20, wire)[0] == Gap(2, 500, LossCause.DEVICE)


def test_a_break_without_a_loss_leaves_no_gap() -> None:
    framing, view, wire = UsbFraming(), np.zeros((SENT, USB_COMPACT_BYTES), np.uint8), encode_usb(FRAMES)
    framing.feed(wire[:2].reshape(-1))
    assert framing.read_into(view) == Chunk(0, 2)
    framing.resume(3, 100, LossCause.USB)
    framing.feed(wire[2:].reshape(-1))
    assert framing.read_into(view) == Chunk(2, SENT - 2)


def test_a_break_before_the_first_frame_is_no_gap() -> None:
    framing, view = UsbFraming(), np.zeros((SENT, USB_COMPACT_BYTES), np.uint8)
    framing.feed(encode_usb(FRAMES).reshape(-1)[:5000])
    framing.resume(3, 100, LossCause.USB)
    framing.feed(encode_usb(FRAMES[:3]).reshape(-1))
    assert framing.read_into(view) == Chunk(0, 3)


def test_a_camera_that_counts_anew_from_below_is_not_dropped_for_ever_as_late() -> None:
    """Both its counters at zero again agree with each other as before, and look like very old frames."""
    count = 1010
    frames = np.repeat(FRAMES[:1], count, axis=0)
    framing = UsbFraming()
    wire = np.concatenate([encode_usb(frames[:4], first=5000).reshape(-1), encode_usb(frames).reshape(-1)])
    taken = take(framing, wire.tobytes(), [])
    assert taken.gaps == [Gap(4, 1000, LossCause.DEVICE)]
    assert len(taken.frames) == 4 + count - 1000
    assert framing.counters.restarts == 1
    assert framing.counters.duplicates == 0


def test_the_structure_of_the_real_sample() -> None:
    """As in the recorded bytes: a stale magic, a whole frame, and the head of one that is 241,232 frames later."""
    later = encode_usb(FRAMES[1:2], first=241_232, lines=3_702_604_173, nbytes=446_614_928)
    whole = encode_usb(FRAMES[:1], lines=3_702_604_173, nbytes=446_614_928)
    framing = UsbFraming()
    taken = take(framing, bytes.fromhex("00636063") + (whole.tobytes() + later.tobytes())[:16_380], [])
    assert list(taken.frames) == [0]
    assert taken.gaps == [Gap(1, 241_231, LossCause.DEVICE), Gap(241_232, 1, LossCause.USB)]
    assert later[0, :16].tobytes() == bytes.fromhex("0063606321001000d0275ace") + (3_762_912_173).to_bytes(4, "little")


@pytest.mark.skipif(not REAL.is_file(), reason="the real bytes in ../shared/wire are not here")
def test_the_real_bytes_hold_one_frame_and_its_gap() -> None:
    taken = take(UsbFraming(), REAL.read_bytes(), [5000])
    assert list(taken.frames) == [0]
    assert int(np.bitwise_count(taken.frames[0]).sum()) == 311
    assert taken.gaps == [Gap(1, 241_231, LossCause.DEVICE), Gap(241_232, 1, LossCause.USB)]


def test_the_benchmark_parses_every_frame_it_times() -> None:
    result = benchmark_usb(frames=40, repeat=1)
    assert result.ratio == pytest.approx(result.parsed_bytes_a_second / result.memcpy_bytes_a_second)
    assert result.parsed_bytes_a_second > 0


@pytest.mark.slow
def test_one_core_parses_four_cameras() -> None:
    """At least 1 GB/s; the camera sends 0.26."""
    assert benchmark_usb().parsed_bytes_a_second > 1e9
