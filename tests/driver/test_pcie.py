"""The PCIe camera's raw stream: what comes out was sent, in order, whatever happened on the way."""

import os
import threading
import time
import tty
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from spiked_driver import card_file
from spiked_driver.pcie import (
    PCIE_COMPACT_BYTES,
    PCIE_FRAME_BYTES,
    PcieFraming,
    PcieSource,
    benchmark_pcie,
    encode_pcie,
)
from spiked_driver.source import Chunk
from spiked_driver.source_kinds import known_devices
from spiked_driver.spec import open_source

from spiked.camera import CameraOptions
from spiked.errors import SourceError
from spiked.ring import DeviceState, End, EndReason, Gap, LossCause

SENT = 6
FRAMES = np.random.default_rng(3).integers(0, 256, (SENT, PCIE_COMPACT_BYTES), np.uint8)
WIRE = encode_pcie(FRAMES)


def take(data: bytes, cuts: list[int]) -> tuple[PcieFraming, list[NDArray[np.uint8]], list[Gap]]:
    """All frames and gaps of a stream fed in pieces, with every index accounted for."""
    framing, view = PcieFraming(), np.zeros((2, PCIE_COMPACT_BYTES), np.uint8)
    frames: list[NDArray[np.uint8]] = []
    gaps: list[Gap] = []
    expected = 0
    bounds = sorted({0, *(cut for cut in cuts if cut < len(data))})
    for start, stop in zip(bounds, [*bounds[1:], len(data)], strict=True):
        framing.feed(data[start:stop])
        if stop == len(data):
            for _ in range(2):
                expected = drain(framing, view, frames, gaps, expected)
                framing.finish()
        expected = drain(framing, view, frames, gaps, expected)
    counters = framing.counters
    assert (counters.received, counters.lost) == (len(frames), sum(gap.count for gap in gaps))
    assert counters.received + counters.lost == framing.next_index == expected
    assert counters.skipped_bytes + counters.received * PCIE_FRAME_BYTES == counters.bytes == len(data)
    return framing, frames, gaps


def drain(
    framing: PcieFraming, view: NDArray[np.uint8], frames: list[NDArray[np.uint8]], gaps: list[Gap], expected: int
) -> int:
    while item := framing.read_into(view):
        assert item.first == expected
        if isinstance(item, Gap):
            gaps.append(item)
            expected += item.count
        else:
            frames.extend(view[: item.frames].copy())
            expected += item.frames
    return expected


def sent_index(frame: NDArray[np.uint8]) -> int:
    wrong = np.bitwise_count(FRAMES ^ frame).sum(axis=1)
    best = int(wrong.argmin())
    assert wrong[best] < 0.001 * 8 * frame.size, "a frame that was never sent"
    return best


@pytest.mark.parametrize("cut", [1, 62, 64, 100_000, PCIE_FRAME_BYTES, PCIE_FRAME_BYTES + 1])
def test_pixels_come_back_whatever_the_chunks(cut: int) -> None:
    _, frames, gaps = take(WIRE.tobytes(), [cut, 2 * cut, 3 * cut + 7])
    np.testing.assert_array_equal(np.stack(frames), FRAMES)
    assert not gaps


def test_a_half_line_holds_500_pixels_a_line_and_a_channel() -> None:
    frame = np.zeros((1, 1000, 1000), np.uint8)
    frame[0, 0, [0, 499, 500, 999]] = 1
    wire = np.unpackbits(encode_pcie(np.packbits(frame, bitorder="little").reshape(1, -1)), bitorder="little")
    first, second = wire[:512], wire[512:1024]
    assert np.flatnonzero(first[:500]).tolist() == [0, 499]
    assert np.flatnonzero(second[:500]).tolist() == [0, 499]
    numbers = [int(half[500:510] @ (1 << np.arange(10))) for half in (first, second)]
    assert numbers == [500, 500]
    last = wire[-512:]
    assert int(last[500:512] @ (1 << np.arange(12))) == 500 | 3 << 10


def test_a_stream_may_begin_within_a_frame() -> None:
    framing, frames, gaps = take(WIRE.reshape(-1)[64_000:].tobytes(), [])
    np.testing.assert_array_equal(np.stack(frames), FRAMES[1:])
    assert not gaps
    assert framing.counters.skipped_bytes == 64_000


def test_one_frame_by_itself_is_taken_at_the_end() -> None:
    _, frames, _ = take(WIRE[0].tobytes(), [])
    np.testing.assert_array_equal(frames[0], FRAMES[0])


def test_a_wrong_line_number_costs_its_frame_and_no_other() -> None:
    wire = WIRE.copy()
    wire[3, 64 * 700 + 63] ^= 0x04
    framing, frames, gaps = take(wire.tobytes(), [])
    assert [sent_index(frame) for frame in frames] == [0, 1, 2, 4, 5]
    assert gaps == [Gap(3, 1, LossCause.USB)]
    assert framing.counters.resyncs == 1


@settings(max_examples=40, deadline=None)
@given(
    damages=st.lists(
        st.tuples(st.sampled_from(["flip", "drop", "junk", "repeat"]), st.floats(0, 0.999), st.integers(1, 60_000)),
        max_size=4,
    ),
    cuts=st.lists(st.integers(1, SENT * PCIE_FRAME_BYTES), max_size=5),
)
def test_no_damage_makes_a_frame_that_was_not_sent(damages: list[tuple[str, float, int]], cuts: list[int]) -> None:
    data = bytearray(WIRE.tobytes())
    for kind, place, span in damages:
        at = int(place * len(data))
        if kind == "flip":
            data[at] ^= 1 + span % 255
        elif kind == "drop":
            del data[at : at + span]
        elif kind == "junk":
            data[at:at] = np.random.default_rng(span).bytes(span)
        else:
            data[at:at] = data[max(0, at - span) : at]
    _, frames, _ = take(bytes(data), cuts)
    indices = [sent_index(frame) for frame in frames]
    assert indices == sorted(set(indices))


def read_all(source: PcieSource) -> tuple[list[NDArray[np.uint8]], End]:
    frames: list[NDArray[np.uint8]] = []
    view = np.zeros((4, PCIE_COMPACT_BYTES), np.uint8)
    while not isinstance(item := source.read_into(view), End):
        if isinstance(item, Chunk):
            assert item.first == len(frames)
            frames.extend(view[: item.frames].copy())
    return frames, item


def test_a_file_is_a_source(tmp_path: Path) -> None:
    path = tmp_path / "raw.dat"
    path.write_bytes(WIRE.tobytes())
    source = PcieSource(path)
    for _ in range(2):
        source.open()
        assert source.can_block
        frames, end = read_all(source)
        np.testing.assert_array_equal(np.stack(frames), FRAMES)
        assert end == End(SENT, EndReason.FINISHED)
        assert source.device_status.state is DeviceState.IDLE
        source.close()


def test_a_pipe_is_a_source_that_cannot_wait(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    source = PcieSource(path)
    source.open()
    sender = threading.Thread(target=path.write_bytes, args=(WIRE.tobytes(),))
    view = np.zeros((4, PCIE_COMPACT_BYTES), np.uint8)
    with path.open("wb"):  # held open, so that the pipe does not end before the sender begins
        assert source.read_into(view) is None
        sender.start()
        first = source.read_into(view)
        while first is None:
            first = source.read_into(view)
    assert isinstance(first, Chunk)
    assert not source.can_block
    np.testing.assert_array_equal(view[: first.frames], FRAMES[: first.frames])
    _rest_of(source, first.frames)
    sender.join()
    source.close()


def _rest_of(source: PcieSource, received: int) -> None:
    view = np.zeros((4, PCIE_COMPACT_BYTES), np.uint8)
    while not isinstance(item := source.read_into(view), End):
        if isinstance(item, Chunk):
            np.testing.assert_array_equal(view[: item.frames], FRAMES[received : received + item.frames])
            received += item.frames
    assert received == SENT


def test_a_character_device_is_a_source_by_its_name() -> None:
    """A pseudo-terminal without any line discipline, as the capture card's node."""
    card, node = os.openpty()
    tty.setraw(node)
    source = open_source(f"pcie:{os.ttyname(node)}?fov=50")
    source.open()
    sender = threading.Thread(target=_write_all, args=(card, WIRE.tobytes()), daemon=True)
    sender.start()
    view, received = np.zeros((4, PCIE_COMPACT_BYTES), np.uint8), 0
    while received < SENT:
        item = source.read_into(view)
        if isinstance(item, Chunk):
            np.testing.assert_array_equal(view[: item.frames], FRAMES[received : received + item.frames])
            received += item.frames
        else:
            assert item is None
    assert not source.can_block
    assert source.device_status.state is DeviceState.STREAMING
    sender.join()
    source.close()
    os.close(card)
    os.close(node)


def _write_all(file: int, data: bytes) -> None:
    sent = 0
    while sent < len(data):
        sent += os.write(file, data[sent : sent + 4096])


class Card:
    """A character device under a name of its own: a pseudo-terminal that ends with a read error."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._controller, self._node = os.openpty()
        tty.setraw(self._node)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._node))

    def send(self, data: bytes) -> threading.Thread:
        """Write from another thread, which ends with the last byte."""
        sender = threading.Thread(target=_write_all, args=(self._controller, data), daemon=True)
        sender.start()
        return sender

    def fail(self) -> None:
        """Reads fail from now on."""
        os.close(self._controller)
        os.close(self._node)


def until(source: PcieSource, state: DeviceState) -> list[tuple[Chunk | Gap, NDArray[np.uint8]]]:
    """Read until the device has that state: items, with the frames of chunks."""
    items: list[tuple[Chunk | Gap, NDArray[np.uint8]]] = []
    view = np.zeros((4, PCIE_COMPACT_BYTES), np.uint8)
    deadline = time.monotonic() + 30
    while source.device_status.state is not state:
        assert time.monotonic() < deadline, source.device_status
        item = source.read_into(view)
        if isinstance(item, Chunk | Gap):
            items.append((item, view[: item.frames].copy() if isinstance(item, Chunk) else view[:0]))
    return items


def read_until_sent(source: PcieSource, sent: threading.Thread) -> None:
    view = np.zeros((4, PCIE_COMPACT_BYTES), np.uint8)
    while sent.is_alive():
        source.read_into(view)


def frames_of(items: list[tuple[Chunk | Gap, NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    return np.concatenate([frames for _, frames in items])


def test_an_absent_card_is_awaited(tmp_path: Path) -> None:
    path = tmp_path / "JR6101"
    source = PcieSource(path)
    source.open()
    assert source.device_status.state is DeviceState.ABSENT
    assert "check the path" in source.device_status.reason
    assert known_devices([f"pcie:{path}"])[0].state is DeviceState.ABSENT
    card = Card(path)
    until(source, DeviceState.ARMED)
    sent = card.send(WIRE.tobytes())
    first, *_ = until(source, DeviceState.STREAMING)
    assert first[0] == Chunk(0, len(first[1]))
    read_until_sent(source, sent)
    source.close()
    card.fail()


def test_a_read_error_is_a_gap_and_a_device_state(tmp_path: Path) -> None:
    warnings: list[str] = []
    path = tmp_path / "JR6101"
    source = PcieSource(path, CameraOptions(rate=1000), warnings.append)
    card = Card(path)
    source.open()
    sent = card.send(WIRE.tobytes())
    began = time.monotonic()
    items = until(source, DeviceState.STREAMING)
    while len(frames_of(items)) < SENT:
        view = np.zeros((4, PCIE_COMPACT_BYTES), np.uint8)
        item = source.read_into(view)
        if isinstance(item, Chunk):
            items.append((item, view[: item.frames].copy()))
    np.testing.assert_array_equal(frames_of(items), FRAMES)
    sent.join()
    card.fail()
    path.unlink()
    assert not until(source, DeviceState.LOST)
    assert "reading failed" in source.device_status.reason
    assert not until(source, DeviceState.ABSENT)
    assert len(warnings) == 1 and warnings[0].endswith("frames until it is read again are lost")
    card = Card(path)
    sent = card.send(WIRE.tobytes())
    (gap, _), *rest = until(source, DeviceState.STREAMING)
    away_s = time.monotonic() - began
    assert isinstance(gap, Gap)
    assert (gap.first, gap.cause) == (SENT, LossCause.DEVICE)
    assert 1 <= gap.count <= 1000 * away_s + 1
    assert gap.count >= 100, "it was away for READ_WAIT_S at least"
    assert isinstance(rest[0][0], Chunk) and rest[0][0].first == SENT + gap.count
    np.testing.assert_array_equal(frames_of(rest), FRAMES[: len(frames_of(rest))])
    read_until_sent(source, sent)
    source.close()
    card.fail()


def test_a_card_that_fails_again_and_again_keeps_the_capture(tmp_path: Path) -> None:
    path = tmp_path / "JR6101"
    source = PcieSource(path)
    source.open()
    for _ in range(3):
        card = Card(path)
        until(source, DeviceState.ARMED)
        card.send(WIRE[0].tobytes()[:2000]).join()
        card.fail()
        until(source, DeviceState.LOST)
        path.unlink()
        until(source, DeviceState.ABSENT)
    source.close()


def test_a_silent_card_is_lost_until_it_sends_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(card_file, "SILENCE_S", 0.05)
    card = Card(tmp_path / "JR6101")
    source = PcieSource(card.path)
    source.open()
    card.send(WIRE.tobytes())
    until(source, DeviceState.STREAMING)
    until(source, DeviceState.LOST)
    assert "nothing was sent" in source.device_status.reason
    sent = card.send(WIRE.tobytes())
    until(source, DeviceState.STREAMING)
    read_until_sent(source, sent)
    source.close()
    card.fail()


def test_a_folder_is_no_card(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="it is a folder"):
        PcieSource(tmp_path).open()


def test_a_file_says_that_it_can_wait_before_it_is_open(tmp_path: Path) -> None:
    path = tmp_path / "raw.dat"
    path.write_bytes(WIRE.tobytes())
    assert open_source(f"pcie:{path}").can_block


def test_the_benchmark_parses_every_frame_it_times() -> None:
    assert benchmark_pcie(frames=4, repeat=1).parsed_bytes_a_second > 0


@pytest.mark.slow
def test_one_core_keeps_up_with_the_capture_card() -> None:
    """At least 2.6 GB/s; the camera sends 2.56."""
    assert benchmark_pcie().parsed_bytes_a_second > 2.6e9
