"""From a simulated camera, with and without faults, through the ring to a reader."""

import re
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from spiked_driver import Chunk, Faults, FaultySource, Loss, Pacer, Source, Stall, acquire
from spiked_driver.simulated import SimulatedSource

from spiked.errors import SourceError
from spiked.ring import (
    DeviceState,
    DeviceStatus,
    End,
    EndReason,
    Frames,
    Gap,
    Item,
    LossCause,
    Policy,
    RingReader,
    RingWriter,
)
from spiked.sensor import Sensor
from spiked.simulate import SimulatedCamera

SENSOR = Sensor(64, 48, 20_000.0)
FRAMES = 200


def simulated(pace: float = 0.0, frames: int | None = FRAMES) -> SimulatedSource:
    return SimulatedSource(SENSOR, seed=3, frames=frames, pace=pace)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """What the simulated camera delivers, uint8 [FRAMES, frame_bytes]."""
    return SimulatedCamera(simulated().sensor, 3).next_frames(FRAMES)


def take_all(reader: RingReader) -> list[tuple[Item, np.ndarray | None]]:
    """Every item to the end, with a copy of the pixels."""
    items: list[tuple[Item, np.ndarray | None]] = []
    while True:
        item = reader.next(10.0)
        assert item is not None, "the capture is silent"
        copy = item.data.copy() if isinstance(item, Frames) else None
        assert not isinstance(item, Frames) or item.release()
        items.append((item, copy))
        if isinstance(item, End):
            return items


def run(source: Source, *, limit_frames: int | None = None) -> tuple[list[tuple[Item, np.ndarray | None]], RingWriter]:
    """Acquire in a thread and read here, losslessly, from the first frame."""
    with RingWriter.create(source.sensor, slots=16) as writer:
        reader = RingReader.attach(writer.name, Policy.LOSSLESS, "test")
        thread = threading.Thread(
            target=acquire,
            args=(source, writer, threading.Event()),
            kwargs={"limit_frames": limit_frames, "consumers": 1},
        )
        thread.start()
        items = take_all(reader)
        thread.join()
        return items, writer


def test_every_frame_arrives_bit_for_bit(truth: np.ndarray) -> None:
    items, writer = run(simulated())
    assert items[-1][0] == End(FRAMES, EndReason.FINISHED)
    np.testing.assert_array_equal(np.concatenate([copy for _, copy in items if copy is not None]), truth)
    assert writer.status().writer.device_status.state is DeviceState.IDLE


def test_losses_are_gaps_and_the_other_frames_stay_what_they_were(truth: np.ndarray) -> None:
    faults = Faults((Loss(13, 4), Loss(100, 30, LossCause.DEVICE, unplugged=True)))
    items, writer = run(FaultySource(simulated(), faults))
    gaps = [item for item, _ in items if isinstance(item, Gap)]
    assert gaps == [Gap(13, 4, LossCause.USB), Gap(100, 30, LossCause.DEVICE)]
    for item, copy in items:
        if isinstance(item, Frames):
            np.testing.assert_array_equal(copy, truth[item.first : item.first + item.count])
    told = writer.status().writer
    assert (told.committed, told.next_frame) == (FRAMES - 34, FRAMES)


def test_blocks_end_at_multiples_of_eight_also_after_a_loss() -> None:
    items, _ = run(FaultySource(simulated(), Faults((Loss(13, 4),))))
    blocks = [(item.first, item.count) for item, _ in items if isinstance(item, Frames)]
    assert blocks[:4] == [(0, 8), (8, 5), (17, 7), (24, 8)]


def test_random_losses_have_about_the_stated_fraction_and_repeat_with_the_seed() -> None:
    faults = Faults(drop=0.3, drop_run=2, seed=5)
    first, writer = run(FaultySource(simulated(frames=400), faults))
    second, _ = run(FaultySource(simulated(frames=400), faults))
    lost = writer.status().writer.lost[LossCause.USB]
    assert 70 < lost < 170
    gaps = [item for item, _ in first if isinstance(item, Gap)]
    assert gaps == [item for item, _ in second if isinstance(item, Gap)]
    assert sum(gap.count for gap in gaps) == lost


class Paced(SimulatedSource):
    """A simulated camera whose frames come at stated times, without waiting for them."""

    def __init__(self, stated_hz: float, periods_ns: np.ndarray) -> None:
        super().__init__(replace(SENSOR, width=16, height=16, frame_rate_hz=stated_hz), frames=len(periods_ns), pace=0)
        self._seen_ns = time.monotonic_ns() + np.cumsum(periods_ns)

    @property
    def can_block(self) -> bool:
        """As a camera: its frames are timed."""
        return False

    def read_into(self, view: np.ndarray) -> Chunk | Gap | End | None:
        """With the time of the last frame."""
        item = super().read_into(view)
        if isinstance(item, Chunk):
            return replace(item, seen_ns=int(self._seen_ns[item.first + item.frames - 1]))
        return item


@pytest.mark.parametrize(
    ("stated_hz", "uneven", "said"),
    [
        (70.0, 0.0, None),
        (75.0, 0.0, "frames come at 70 a second by their count and this machine's clock, not at the stated 75: set"),
        (20_000.0, 0.6, r"frames come unevenly, now at \d+ a second .*: times are those of the stated rate"),
    ],
    ids=["as stated", "another", "another, unevenly"],
)
def test_a_rate_that_is_not_the_stated_one_is_told(stated_hz: float, uneven: float, said: str | None) -> None:
    """70 frames a second for 30 s; uneven ones change their rate every second."""
    change = np.repeat(np.random.default_rng(0).uniform(-1, 1, 30), 70)
    told: list[str] = []
    source = Paced(stated_hz, (1e9 / 70 * (1 + uneven * change)).astype(np.int64))
    with RingWriter.create(source.sensor, slots=1024) as writer:
        acquire(source, writer, threading.Event(), warn=told.append)
    assert len(told) == (said is not None)
    assert said is None or re.match(said, told[0])


def test_a_loss_at_the_end_comes_before_the_end() -> None:
    items, _ = run(FaultySource(simulated(), Faults((Loss(FRAMES - 5, 50),))))
    assert [item for item, _ in items[-2:]] == [Gap(FRAMES - 5, 5, LossCause.USB), End(FRAMES, EndReason.FINISHED)]


def test_nested_faults_come_in_order() -> None:
    inner = FaultySource(simulated(), Faults((Loss(20, 10, LossCause.DEVICE),)))
    items, _ = run(FaultySource(inner, Faults((Loss(16, 20),))))
    gaps = [item for item, _ in items if isinstance(item, Gap)]
    assert gaps == [Gap(16, 4, LossCause.USB), Gap(20, 10, LossCause.DEVICE), Gap(30, 6, LossCause.USB)]


def test_a_limit_ends_the_capture_at_that_frame_even_within_a_block_or_a_gap() -> None:
    items, writer = run(simulated(), limit_frames=50)
    assert items[-1][0] == End(50, EndReason.FINISHED)
    items, writer = run(FaultySource(simulated(), Faults((Loss(45, 20),))), limit_frames=50)
    assert [item for item, _ in items[-2:]] == [Gap(45, 5, LossCause.USB), End(50, EndReason.FINISHED)]
    assert writer.status().writer.committed == 45


def test_a_capture_can_be_stopped_while_the_source_is_stalled() -> None:
    stop = threading.Event()
    source = FaultySource(simulated(), Faults(stalls=(Stall(20, 3600.0),)))
    with RingWriter.create(source.sensor, slots=16) as writer:
        reader = RingReader.attach(writer.name, Policy.LOSSLESS, "test")
        reasons: list[EndReason] = []
        thread = threading.Thread(target=lambda: reasons.append(acquire(source, writer, stop)))
        thread.start()
        first = [reader.next(10.0) for _ in range(2)]
        stop.set()
        items = take_all(reader)
        thread.join()
    assert [(item.first, item.count) for item in first if isinstance(item, Frames)] == [(0, 8), (8, 8)]
    assert reasons == [EndReason.STOPPED]
    assert items[-1][0] == End(20, EndReason.STOPPED)


def test_an_unplugged_device_is_seen_as_lost_while_it_is_away() -> None:
    source = FaultySource(simulated(), Faults((Loss(8, 8, LossCause.DEVICE, unplugged=True),)))
    source.open()
    view = np.zeros((4, source.sensor.frame_bytes), np.uint8)
    seen = []
    for _ in range(5):
        seen.append((source.read_into(view), source.device_status.state))
    source.close()
    assert seen == [
        (Chunk(0, 4), DeviceState.STREAMING),
        (Chunk(4, 4), DeviceState.STREAMING),
        (None, DeviceState.LOST),
        (Gap(8, 8, LossCause.DEVICE), DeviceState.STREAMING),
        (Chunk(16, 4), DeviceState.STREAMING),
    ]


def test_an_error_of_the_source_ends_the_capture_as_failed_and_says_why() -> None:
    class Broken(SimulatedSource):
        """A camera whose cable breaks after three blocks."""

        def read_into(self, view: np.ndarray) -> Chunk | Gap | End | None:
            if self._next >= 24:
                raise SourceError("the cable broke")
            return super().read_into(view)

    source = Broken(SENSOR, seed=3, frames=FRAMES, pace=0)
    with RingWriter.create(source.sensor, slots=16) as writer:
        reader = RingReader.attach(writer.name, Policy.LOSSLESS, "test")
        with pytest.raises(SourceError, match="cable"):
            acquire(source, writer, threading.Event())
        assert take_all(reader)[-1][0] == End(24, EndReason.FAILED)
        assert writer.status().writer.device_status == DeviceStatus(DeviceState.LOST, "the cable broke")


def test_a_source_that_renumbers_or_skips_frames_is_refused() -> None:
    class Renumbering(SimulatedSource):
        """A camera that calls frame 8 another number."""

        number = 0

        def read_into(self, view: np.ndarray) -> Chunk | Gap | End | None:
            chunk = super().read_into(view)
            return Chunk(self.number, chunk.frames) if isinstance(chunk, Chunk) and chunk.first else chunk

    for number, message in ((9, "jumped from frame 8 to 9"), (7, "delivered frame 7 again")):
        source = Renumbering(SENSOR, seed=3, frames=FRAMES, pace=0)
        source.number = number
        with RingWriter.create(source.sensor, slots=16) as writer, pytest.raises(SourceError, match=message):
            acquire(source, writer, threading.Event())


def test_frames_are_timed_by_when_the_source_had_them() -> None:
    """And not by when it has unpacked them."""
    begin_ns = time.monotonic_ns()

    class Live(SimulatedSource):
        """A camera whose frames came at its rate, from a minute ago on."""

        can_block = False

        def read_into(self, view: np.ndarray) -> Chunk | Gap | End | None:
            chunk = super().read_into(view)
            if not isinstance(chunk, Chunk):
                return chunk
            last = chunk.first + chunk.frames
            return replace(chunk, seen_ns=begin_ns + round((last / SENSOR.frame_rate_hz - 60) * 1e9))

    source = Live(SENSOR, seed=3, frames=FRAMES, pace=0)
    with RingWriter.create(source.sensor, slots=16) as writer:
        reader = RingReader.attach(writer.name, Policy.LOSSLESS, "test")
        unix_ns = time.time_ns()
        acquire(source, writer, threading.Event())
        take_all(reader)
        for pair in (pairs := reader.clock_pairs()):
            came_ns = unix_ns + ((pair.frame + 1) / SENSOR.frame_rate_hz - 60) * 1e9
            assert pair.unix_ns == pytest.approx(came_ns, abs=1e9)
    assert pairs


def test_a_paced_source_keeps_to_its_rate_without_adding_up_delays() -> None:
    pacer = Pacer(1000.0, 0.5)
    assert pacer.remaining_s(8, now_s=10.0) == pytest.approx(8 / 500)
    assert pacer.remaining_s(16, now_s=10.02) == pytest.approx(16 / 500 - 0.02)
    assert pacer.remaining_s(24, now_s=20.0) < 0
    assert Pacer(1000.0, 0.0).remaining_s(1_000_000, now_s=0.0) == 0


def test_a_source_with_nothing_to_give_yet_comes_back_with_nothing() -> None:
    source = SimulatedSource(Sensor(64, 48, 1.0), seed=3, frames=100, pace=1.0)
    source.open()
    assert source.read_into(np.zeros((8, source.sensor.frame_bytes), np.uint8)) is None
    assert source.device_status.state is DeviceState.ARMED


def test_a_camera_is_not_opened_before_its_frames_are_awaited() -> None:
    """An open camera sends, and what nobody takes yet would be lost."""
    opened = threading.Event()

    class Watched(SimulatedSource):
        def open(self) -> None:
            opened.set()
            super().open()

    source = Watched(SENSOR, seed=3, frames=8)
    with RingWriter.create(source.sensor, slots=16) as writer:
        thread = threading.Thread(target=acquire, args=(source, writer, threading.Event()), kwargs={"consumers": 1})
        thread.start()
        assert not opened.wait(0.2)
        reader = RingReader.attach(writer.name, Policy.LOSSLESS, "test")
        assert opened.wait(10)
        take_all(reader)
        thread.join()
