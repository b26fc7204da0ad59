"""The acquisition worker: a source into a ring, and nothing else."""

import math
import shutil

from spiked_driver.acquisition import acquire
from spiked_driver.realtime import take_priority
from spiked_driver.source import Source
from spiked_driver.spec import is_camera, open_source

from spiked.ring import RingWriter
from spiked.ring.segment import FOLDER
from spiked.ring.writer import DEFAULT_BYTES, MOST_BACKLOG_BYTES
from spiked.sensor import Sensor
from spiked_service.messages import AcquisitionOrder, RingOpened, Warned
from spiked_service.worker import Link

_BLOCK_FRAMES = 8
_SLOTS_UNHURRIED = 64
"""A source that waits stays this little ahead of the slowest consumer, so that what is seen live belongs together.

Four times what the recorder holds at most and has not written (`_BATCH_BLOCKS`): its successor begins so far back.
"""
_MOURNING_S = 15.0
"""A source that waits holds its frames so long for the successor of a consumer that was killed."""
_HISTORY_SHARE = 0.4
"""Part of the ring that a lossless reader may begin in the past; it may lag half of it."""


def run_acquisition(order: AcquisitionOrder, link: Link) -> None:
    """Raises SourceError, RecordingError or RingError, which end the capture."""
    source = open_source(order.source)
    sensor = source.sensor
    limit = order.frames if order.seconds is None else max(1, round(order.seconds * sensor.frame_rate_hz))
    with _ring(order, source) as writer:
        if order.ring is None:
            link.tell(
                RingOpened(
                    name=writer.name,
                    sensor=sensor,
                    frames=limit if limit is not None else source.frames,
                    unhurried=source.waits,
                )
            )
        if is_camera(order.source):
            for note in take_priority():
                link.tell(Warned(text=note))
        consumers = order.consumers if order.ring is None else 0
        acquire(source, writer, link.stop, limit_frames=limit, consumers=consumers, died_s=order.died_s)


def _ring(order: AcquisitionOrder, source: Source) -> RingWriter:
    """A new one, or that of a process that died. Raises RingError."""
    if order.ring is not None:
        return RingWriter.take_over(order.ring, mourning_s=_MOURNING_S)
    slots = _slots(source.sensor, order.history_s, order.backlog_s, source.waits)
    return RingWriter.create(
        source.sensor, slots=slots, block_frames=_BLOCK_FRAMES, ring_id=order.ring_id, mourning_s=_MOURNING_S
    )


def _slots(sensor: Sensor, history_s: float, backlog_s: float, waits: bool) -> int | None:
    """Slots of the ring; None for the usual number."""
    if waits and not history_s:
        return _SLOTS_UNHURRIED
    slot_bytes = _BLOCK_FRAMES * sensor.compact().frame_bytes
    slots_a_second = sensor.frame_rate_hz / _BLOCK_FRAMES
    wanted = math.ceil(history_s * slots_a_second / _HISTORY_SHARE)
    if not waits:
        # Catching up from afar is a comfort: it leaves room for other captures.
        room = min(MOST_BACKLOG_BYTES, shutil.disk_usage(FOLDER).free // 2)
        wanted = max(wanted, min(math.ceil(backlog_s * slots_a_second), room // slot_bytes))
    return wanted if wanted > DEFAULT_BYTES // slot_bytes else None
