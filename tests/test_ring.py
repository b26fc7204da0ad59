"""The ring inside one process: order, policies, accounting, and what it refuses."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spiked.ring import (
    ClockPair,
    DeviceState,
    DeviceStatus,
    End,
    EndReason,
    Frames,
    Gap,
    Item,
    LossCause,
    Policy,
    Ring,
    RingError,
    RingReader,
    RingWriter,
    clean_stale,
)
from spiked.sensor import Layout, Mosaic, Sensor

SENSOR = Sensor(64, 8, 20_000.0)
"""64 bytes a frame: room for the frame's own index, so that content can be checked."""


def put(writer: RingWriter, frames: int) -> None:
    """Commit a block whose frames hold their own index."""
    view = writer.acquire()
    view[:frames].view(np.int64)[:] = np.arange(writer.next_frame, writer.next_frame + frames)[:, None]
    writer.commit(frames)


def drain(reader: RingReader) -> list[Item]:
    """All that is there now, each block released at once."""
    items: list[Item] = []
    while (item := reader.next(0)) is not None:
        if isinstance(item, Frames):
            check_content(item)
        items.append(item)
        if isinstance(item, End):
            break
    return items


def check_content(frames: Frames) -> None:
    expected = np.arange(frames.first, frames.first + frames.count)
    copy = np.array(frames.data).view(np.int64)
    if frames.release():
        np.testing.assert_array_equal(copy, np.broadcast_to(expected[:, None], copy.shape))


def spans(items: list[Item]) -> list[tuple[int, int]]:
    return [(item.first, item.count) for item in items if not isinstance(item, End)]


def assert_contiguous(items: list[Item]) -> int:
    """Every frame came once, in order; returns the next frame's index."""
    expected = 0
    for first, count in spans(items):
        assert first == expected
        expected += count
    return expected


@pytest.fixture
def writer() -> Iterator[RingWriter]:
    with RingWriter.create(SENSOR, slots=16) as writer:
        yield writer


def attach(writer: RingWriter, policy: Policy = Policy.LOSSLESS) -> RingReader:
    return RingReader.attach(writer.name, policy, "test")


def test_frames_and_gaps_come_in_order(writer: RingWriter) -> None:
    reader = attach(writer)
    put(writer, 8)
    put(writer, 5)
    writer.gap(100, LossCause.USB)
    writer.gap(7, LossCause.DEVICE)
    put(writer, 8)
    writer.end(EndReason.FINISHED)
    items = drain(reader)
    assert spans(items) == [(0, 8), (8, 5), (13, 100), (113, 7), (120, 8)]
    assert items[2:4] == [Gap(13, 100, LossCause.USB), Gap(113, 7, LossCause.DEVICE)]
    assert items[-1] == End(128, EndReason.FINISHED)


def test_the_end_comes_again_and_ending_twice_keeps_the_first_reason(writer: RingWriter) -> None:
    reader = attach(writer)
    writer.end(EndReason.STOPPED)
    writer.end(EndReason.FAILED)
    assert [reader.next(0), reader.next(0)] == [End(0, EndReason.STOPPED)] * 2


def test_views_are_of_the_ring_itself_and_read_only(writer: RingWriter) -> None:
    reader = attach(writer)
    view = writer.acquire()
    view[:] = 7
    writer.commit(8)
    frames = reader.next(0)
    assert isinstance(frames, Frames)
    assert not frames.data.flags.writeable
    assert frames.data.shape == (8, SENSOR.frame_bytes)
    view[0, 0] = 9  # what no writer does: it shows that the reader sees the same memory
    assert frames.data[0, 0] == 9


def test_attaching_needs_only_the_name() -> None:
    sensor = Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED, mosaic=Mosaic.RGGB)
    with RingWriter.create(sensor, slots=8, block_frames=4) as writer:
        reader = attach(writer)
        assert reader.geometry.sensor == sensor.compact()
        assert (reader.geometry.slots, reader.geometry.block_frames) == (8, 4)


def test_a_lossless_reader_gets_everything_within_half_of_the_ring(writer: RingWriter) -> None:
    reader = attach(writer)
    for _ in range(8):
        put(writer, 8)
    assert spans(drain(reader)) == [(8 * i, 8) for i in range(8)]
    assert not writer.status().readers[0].lagging


def test_an_overrun_lossless_reader_gets_a_gap_and_is_marked_until_it_catches_up(writer: RingWriter) -> None:
    reader = attach(writer)
    put(writer, 8)
    drain(reader)
    for _ in range(9):
        put(writer, 8)
    gap = reader.next(0)
    assert isinstance(gap, Gap)
    assert (gap.first, gap.cause) == (8, LossCause.RING)
    status = writer.status().readers[0]
    assert status.lagging
    assert (status.overruns, status.lost) == (1, gap.count)
    drain(reader)
    assert not writer.status().readers[0].lagging


def test_a_priority_reader_has_the_deeper_lease(writer: RingWriter) -> None:
    lossless, priority = attach(writer), attach(writer, Policy.PRIORITY)
    for _ in range(14):
        put(writer, 8)
    assert isinstance(lossless.next(0), Gap)
    assert spans(drain(priority)) == [(8 * i, 8) for i in range(14)]


def test_the_latest_policy_skips_to_the_newest_block_and_says_how_much(writer: RingWriter) -> None:
    reader = attach(writer, Policy.LATEST)
    for _ in range(5):
        put(writer, 8)
    gap = reader.next(0)
    put(writer, 8)  # the block promised by the gap comes, even if a newer one is there by now
    frames = reader.next(0)
    assert gap == Gap(0, 32, LossCause.RING)
    assert isinstance(frames, Frames)
    assert frames.first == 32


def test_joining_late_is_a_gap_but_no_overrun(writer: RingWriter) -> None:
    for _ in range(40):
        put(writer, 8)
    reader = attach(writer)
    items = drain(reader)
    assert isinstance(items[0], Gap)
    assert assert_contiguous(items) == 320
    assert writer.status().readers[0].overruns == 0


def test_a_view_tells_when_it_was_overwritten_and_its_frames_count_as_lost(writer: RingWriter) -> None:
    reader = attach(writer)
    put(writer, 8)
    frames = reader.next(0)
    assert isinstance(frames, Frames)
    for _ in range(15):
        put(writer, 8)
    assert frames.valid()
    writer.acquire()
    writer.commit(1)
    assert not frames.valid()
    assert not frames.release()
    gap = reader.next(0)
    assert isinstance(gap, Gap)
    assert (gap.first, gap.cause) == (0, LossCause.RING)


def test_a_view_overwritten_at_the_end_of_the_capture_is_told_of_before_the_end(writer: RingWriter) -> None:
    reader = attach(writer, Policy.LATEST)
    put(writer, 8)
    frames = reader.next(0)
    assert isinstance(frames, Frames)
    for _ in range(16):
        put(writer, 8)
    writer.end(EndReason.FINISHED)
    items = drain(reader)
    assert assert_contiguous(items) == 17 * 8
    assert items[0] == Gap(0, 128, LossCause.RING)


def test_as_context_manager_frames_say_afterwards_whether_they_were_whole(writer: RingWriter) -> None:
    reader = attach(writer)
    put(writer, 8)
    frames = reader.next(0)
    assert isinstance(frames, Frames)
    with frames as data:
        assert data[3].view(np.int64)[0] == 3
    assert frames.valid()
    assert writer.status().readers[0].frames_read == 8


def test_a_storm_of_gaps_without_frames_keeps_the_account(writer: RingWriter) -> None:
    reader = attach(writer)
    for _ in range(1000):
        writer.gap(3, LossCause.DEVICE)
    writer.end(EndReason.STOPPED)
    items = drain(reader)
    assert assert_contiguous(items) == 3000


def test_slots_acquired_ahead_are_committed_in_order_with_gaps_between(writer: RingWriter) -> None:
    reader = attach(writer)
    first, second = writer.acquire(), writer.acquire()
    second[:] = 2
    first[:] = 1
    writer.commit(8)
    writer.gap(8, LossCause.USB)
    writer.commit(8)
    values = []
    while (item := reader.next(0)) is not None:
        values.append(int(item.data[0, 0]) if isinstance(item, Frames) else item)
    assert values == [1, Gap(8, 8, LossCause.USB), 2]


def test_a_writer_that_can_wait_has_space_while_no_reader_would_lose(writer: RingWriter) -> None:
    reader, skipping = attach(writer), attach(writer, Policy.LATEST)
    for _ in range(8):
        assert writer.has_space()
        put(writer, 8)
    assert not writer.wait_for_space(0.01)
    reader.next(0)
    assert not writer.has_space()  # the block is being read
    reader.next(0)
    assert writer.has_space()
    reader.close()
    for _ in range(20):
        assert writer.has_space()
        put(writer, 8)
    skipping.close()


def test_a_successor_may_begin_before_what_a_killed_reader_gave_back(writer: RingWriter) -> None:
    slots = writer.geometry.slots
    recorder = attach(writer, Policy.PRIORITY)
    for _ in range(slots):
        put(writer, 8)
        drain(recorder)
    given_back = recorder.status().readers[0].next_frame
    while writer.has_space():
        put(writer, 8)
    recorder.close()  # what it still had in its memory is lost with it
    start = given_back - 8 * (slots // 4)
    successor = RingReader.attach(writer.name, Policy.PRIORITY, "test", start)
    before, *items = drain(successor)
    assert before == Gap(0, start, LossCause.RING)
    assert items and [type(item) for item in items] == [Frames] * len(items)
    successor.close()


_DYING = """
import os, signal, sys
from spiked.ring import RingWriter
from spiked.sensor import Sensor
writer = RingWriter.create(Sensor(64, 8, 20_000.0), slots=16)
for count in (8, 8, 5):
    writer.acquire()[:] = 1
    writer.commit(count)
writer.acquire()[:] = 2
print(writer.name, flush=True)
sys.stdin.readline()
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def dying() -> Iterator["subprocess.Popen[str]"]:
    """A writer that has published 21 frames, begun a slot, and is killed when it reads a line."""
    clean_stale()  # what others left behind is not this test's
    command = [sys.executable, "-c", _DYING]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()
    clean_stale()


def test_a_ring_that_is_held_is_gone_on_with(dying: "subprocess.Popen[str]") -> None:
    assert dying.stdout is not None
    name = dying.stdout.readline().strip()
    outside, reader = Ring.attach(name), RingReader.attach(name, Policy.LOSSLESS, "test", 0)
    dying.communicate("die\n")
    assert outside.claim_for_successor("it died")
    assert name not in clean_stale()
    counts = []
    while isinstance(item := reader.next(0.7), Frames):
        counts.append(item.count)
    assert (counts, item) == ([8, 8, 5], None)
    assert outside.status().writer.device_status == DeviceStatus(DeviceState.LOST, "it died")
    successor = RingWriter.take_over(name)
    successor.gap(16, LossCause.USB)
    successor.acquire()[:] = 3
    successor.commit(3)
    assert reader.next(0) == Gap(21, 16, LossCause.USB)
    item = reader.next(0)
    assert isinstance(item, Frames) and (item.first, item.count) == (37, 3) and (item.data == 3).all()
    successor.close(EndReason.FINISHED)
    assert reader.next(0) == End(40, EndReason.FINISHED)
    assert not outside.claim_for_successor("it ended")
    with pytest.raises(RingError):
        RingWriter.take_over(name)


def test_a_ring_that_is_given_up_ends_at_once(dying: "subprocess.Popen[str]") -> None:
    assert dying.stdout is not None
    name = dying.stdout.readline().strip()
    outside, reader = Ring.attach(name), RingReader.attach(name, Policy.LATEST, "test")
    dying.communicate("die\n")
    assert outside.claim_for_successor("it died")
    while reader.next(0) is not None:
        pass
    outside.abandon()
    assert reader.next(0.3) == End(21, EndReason.WRITER_DIED)
    clean_stale()
    assert not Path("/dev/shm", name).exists()


def test_status_is_visible_from_outside_and_outlives_the_name() -> None:
    with RingWriter.create(SENSOR, slots=8) as writer:
        ring = Ring.attach(writer.name)
        reader = attach(writer)
        writer.publish_device_status(DeviceStatus(DeviceState.STREAMING, "as it should"))
        put(writer, 8)
        writer.gap(4, LossCause.USB)
        put(writer, 8)
        drain(reader)
        before = ring.status()
    after = ring.status()
    assert before.writer.device_status == DeviceStatus(DeviceState.STREAMING, "as it should")
    assert (before.writer.committed, before.writer.next_frame, before.writer.end) == (16, 20, None)
    assert before.writer.lost == {LossCause.DEVICE: 0, LossCause.USB: 4, LossCause.RING: 0, LossCause.DISK: 0}
    (row,) = before.readers
    assert (row.consumer, row.frames_read, row.lost, row.lag_frames, row.alive) == ("test", 16, 4, 0, True)
    assert after.writer.end is EndReason.STOPPED


def test_what_a_ring_had_counted_before_a_frame(writer: RingWriter) -> None:
    ring = Ring.attach(writer.name)
    assert (ring.counted_before(0).block, ring.counted_before(5).block) == (0, 0)
    put(writer, 8)
    writer.gap(4, LossCause.USB)
    put(writer, 6)
    writer.clock_pair(ClockPair(17, 1))
    writer.gap(5, LossCause.DEVICE)
    put(writer, 5)
    expected = {
        0: (0, 0, 0),
        7: (0, 0, 0),
        10: (8, 2, 0),
        12: (12, 4, 0),
        17: (12, 4, 0),
        20: (18, 4, 2),
        28: (23, 4, 5),
    }
    for frame, (block, usb, device) in expected.items():
        found = ring.counted_before(frame)
        assert (found.frame, found.block) == (frame, block)
        assert (found.lost[LossCause.USB], found.lost[LossCause.DEVICE], found.lost[LossCause.RING]) == (usb, device, 0)
    for _ in range(200):  # the log forgets
        put(writer, 8)
        writer.gap(1, LossCause.USB)
    whole = ring.status().writer
    assert ring.counted_before(whole.next_frame).lost == whole.lost
    assert ring.counted_before(whole.next_frame - 9).lost[LossCause.USB] == 204 - 1
    assert 4 < ring.counted_before(20).lost[LossCause.USB] < 204


def test_texts_too_long_for_shared_memory_are_cut_between_characters(writer: RingWriter) -> None:
    writer.publish_device_status(DeviceStatus(DeviceState.LOST, "x" + "é" * 200))
    with RingReader.attach(writer.name, Policy.LATEST, "x" + "é" * 40):
        status = writer.status()
    assert status.writer.device_status.reason == "x" + "é" * 95
    assert status.readers[0].consumer == "x" + "é" * 23


def test_the_name_is_gone_after_closing_and_readers_read_on() -> None:
    with RingWriter.create(SENSOR, slots=8) as writer:
        reader = attach(writer)
        put(writer, 8)
    assert not Path("/dev/shm", writer.name).exists()
    assert spans(drain(reader)) == [(0, 8)]
    with pytest.raises(RingError, match="there is no ring"):
        attach(writer)


def test_a_name_is_given_once() -> None:
    with RingWriter.create(SENSOR, slots=8, ring_id=f"test-{os.getpid()}") as writer:
        with pytest.raises(RingError, match="already"):
            RingWriter.create(SENSOR, slots=8, ring_id=f"test-{os.getpid()}")
        put(writer, 8)
        assert spans(drain(attach(writer))) == [(0, 8)]


def test_a_ring_that_does_not_fit_is_refused_before_anything_is_written() -> None:
    with pytest.raises(RingError, match="are free"):
        RingWriter.create(Sensor(4000, 4000, 1000.0), slots=1 << 20)


def test_impossible_calls_are_refused(writer: RingWriter) -> None:
    with pytest.raises(RingError, match="no slot"):
        writer.commit(1)
    writer.acquire()
    writer.acquire()
    with pytest.raises(RingError, match="not committed"):
        writer.acquire()
    with pytest.raises(RingError, match="9"):
        writer.commit(9)
    with pytest.raises(RingError, match="gap of 0"):
        writer.gap(0, LossCause.USB)
    writer.end(EndReason.STOPPED)
    with pytest.raises(RingError, match="ended"):
        writer.commit(1)


def test_there_are_places_for_sixteen_readers_and_a_closed_one_is_free_again(writer: RingWriter) -> None:
    readers = [attach(writer) for _ in range(16)]
    with pytest.raises(RingError, match="16 readers"):
        attach(writer)
    readers[3].close()
    attach(writer)
    assert len(writer.status().readers) == 16


def test_a_foreign_file_with_the_name_of_a_ring_is_neither_attached_nor_cleaned() -> None:
    path = Path("/dev/shm", f"spiked-foreign-{os.getpid()}")
    path.write_bytes(b"not a ring")
    try:
        with pytest.raises(RingError):
            RingReader.attach(path.name, Policy.LATEST, "test")
        assert path.name not in clean_stale()
        assert path.exists()
    finally:
        path.unlink()


def test_the_ring_of_a_dead_creator_is_cleaned_and_that_of_a_living_one_is_not(writer: RingWriter) -> None:
    code = "from spiked.ring import *; from spiked.sensor import *; import os; "
    code += "print(RingWriter.create(Sensor(64, 8, 1.0), slots=8).name, flush=True); os._exit(1)"
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    name = done.stdout.strip()
    assert Path("/dev/shm", name).exists()
    clean_stale()
    assert not Path("/dev/shm", name).exists()
    assert Path("/dev/shm", writer.name).exists()


Step = tuple[str, int]
steps = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.integers(1, 8)),
        st.tuples(st.just("gap"), st.integers(1, 50)),
        st.tuples(st.just("stall"), st.integers(1, 30)),
        st.tuples(st.just("read"), st.integers(0, 2)),
        st.tuples(st.just("hold"), st.integers(0, 2)),
    ),
    max_size=60,
)


@settings(max_examples=100, deadline=None)
@given(steps)
def test_whatever_happens_each_frame_is_read_or_lost_once(script: list[Step]) -> None:
    with RingWriter.create(SENSOR, slots=8) as writer:
        readers = [attach(writer, policy) for policy in Policy]
        taken: list[list[Item]] = [[] for _ in readers]
        for kind, number in script:
            if kind == "put":
                put(writer, number)
            elif kind == "gap":
                writer.gap(number, LossCause.DEVICE)
            elif kind == "stall":
                for _ in range(number):
                    put(writer, 8)
            elif (item := readers[number].next(0)) is not None:
                taken[number].append(item)
                if kind == "read" and isinstance(item, Frames):
                    check_content(item)
            for row in writer.status().readers:
                assert row.frames_read + row.lost == row.next_frame
        writer.end(EndReason.FINISHED)
        for reader, items in zip(readers, taken, strict=True):
            items.extend(drain(reader))
            assert items[-1] == End(writer.next_frame, EndReason.FINISHED)
            told = [item for item in items if isinstance(item, Gap) or (isinstance(item, Frames) and item.valid())]
            assert assert_contiguous(told) == writer.next_frame
        for row in writer.status().readers:
            assert row.frames_read + row.lost == row.next_frame == writer.next_frame


def test_a_reader_may_start_at_a_frame_that_the_ring_still_holds() -> None:
    with RingWriter.create(SENSOR, slots=64, block_frames=8) as writer:
        for _ in range(40):
            writer.acquire()[:] = 0
            writer.commit(8)
        for start, first in ((200, 200), (203, 200), (0, 0), (319, 312)):
            with RingReader.attach(writer.name, Policy.PRIORITY, "late", start_frame=start) as reader:
                items = [reader.next(0)]
                if first:
                    assert items[0] == Gap(0, first, LossCause.RING)
                    items = [reader.next(0)]
                assert isinstance(items[0], Frames)
                assert items[0].first == first
                assert reader.overruns == 0


def test_a_reader_that_starts_too_far_back_gets_what_there_is() -> None:
    with RingWriter.create(SENSOR, slots=16, block_frames=8) as writer:
        for _ in range(40):
            writer.acquire()[:] = 0
            writer.commit(8)
        with RingReader.attach(writer.name, Policy.PRIORITY, "late", start_frame=3) as reader:
            gap, frames = reader.next(0), reader.next(0)
            assert isinstance(gap, Gap) and isinstance(frames, Frames)
            assert frames.first == gap.count >= (40 - 16) * 8
            assert frames.valid()


def test_an_onlooker_begins_at_the_newest_block_and_counts_what_it_loses(writer: RingWriter) -> None:
    for _ in range(3):
        put(writer, 8)
    writer.clock_pair(ClockPair(23, 5_000))
    put(writer, 8)
    reader = RingReader.watch(writer.name)
    assert spans(drain(reader)) == [(24, 8)]
    assert reader.clock_pairs() == [ClockPair(23, 5_000)]
    for _ in range(20):
        put(writer, 8)
    writer.end(EndReason.FINISHED)
    items = drain(reader)
    assert isinstance(items[0], Gap) and items[0].first == 32 and items[0].cause is LossCause.RING
    assert items[0].count + sum(count for _, count in spans(items[1:])) == 160
    assert items[-1] == End(192, EndReason.FINISHED)


def test_an_onlooker_that_comes_before_the_first_frame_gets_all(writer: RingWriter) -> None:
    reader = RingReader.watch(writer.name)
    put(writer, 8)
    put(writer, 3)
    assert spans(drain(reader)) == [(0, 8), (8, 3)]


def test_an_onlooker_has_no_place_and_no_source_waits_for_it(writer: RingWriter) -> None:
    reader = RingReader.watch(writer.name)
    for _ in range(40):
        assert writer.wait_for_space(0)
        put(writer, 8)
    assert writer.status().readers == ()
    assert not writer.wait_for_readers(1, 0)
    assert not reader._segment.slot(0, 1).flags.writeable  # nothing in this process can write the ring through it


def test_an_onlooker_makes_no_reader_with_a_place(writer: RingWriter) -> None:
    reader = RingReader.watch(writer.name)
    with pytest.raises(RingError, match="an onlooker of ring"):
        reader.another(Policy.LOSSLESS, "late", 0)


def test_a_reader_closed_twice_frees_only_its_own_place(writer: RingWriter) -> None:
    first = attach(writer)
    first.close()
    second = RingReader.attach(writer.name, Policy.LOSSLESS, "second")
    put(writer, 8)
    assert isinstance(first.next(0), Frames)
    first.close()
    assert [(one.consumer, one.frames_read) for one in writer.status().readers] == [("second", 0)]
    second.close()
    assert writer.status().readers == ()


def test_a_ring_that_cannot_be_mapped_leaves_no_name() -> None:
    program = """
import resource
from spiked.ring import RingError, RingWriter
from spiked.sensor import Sensor
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (8 << 20),) * 2)
try:
    RingWriter.create(Sensor(400, 250, 20_000.0), slots=1024, ring_id="unmappable")
except RingError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "cannot be mapped" in done.stdout
    assert not Path("/dev/shm/spiked-unmappable").exists()
