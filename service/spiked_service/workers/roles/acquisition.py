"""The acquisition worker: writes the frames of a source into a ring."""

import math
import shutil

from spiked_driver.acquisition import acquire
from spiked_driver.realtime import take_priority
from spiked_driver.source import Source
from spiked_driver.source_kinds import is_camera
from spiked_driver.spec import open_camera

from spiked.ring import RingWriter
from spiked.ring.segment import FOLDER
from spiked.ring.writer import DEFAULT_BYTES, MOST_BACKLOG_BYTES
from spiked.sensor import Sensor
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import AcquisitionCommand, RingOpened, Warned

_BLOCK_FRAMES = 8
"""Frames of a slot."""
_UNPACED_SLOTS = 64
"""Ring slots of a source that can block: its largest lead over the slowest reader.

Four times the largest backlog of the recorder (`_BATCH_BLOCKS`), where the successor of a killed recorder starts.
"""
_TAKEOVER_GRACE_S = 15.0
"""Time that a source that can block waits for the successor of a killed reader."""
_HISTORY_SHARE = 0.4
"""Share of the ring in which a lossless reader may start; it may lag by half of the ring."""


def run_acquisition(command: AcquisitionCommand, channel: WorkerChannel) -> None:
    """Acquire until the end of the source. Raises a SpikedError, which ends the capture."""

    def warn(text: str) -> None:
        channel.send(Warned(text=text))

    opened = open_camera(command.source, warn, command.profiles)
    source = opened.source
    sensor = source.sensor
    limit = command.frames if command.seconds is None else max(1, round(command.seconds * sensor.frame_rate_hz))
    with _ring(command, source) as writer:
        if command.ring is None:
            channel.send(
                RingOpened(
                    name=writer.name,
                    sensor=sensor,
                    frames=limit if limit is not None else source.frames,
                    can_block=source.can_block,
                    profile=opened.profile,
                    calibration=opened.calibration,
                    assumed=opened.assumed,
                )
            )
        if is_camera(command.source):
            for note in take_priority():
                warn(note)
        consumers = 0 if writer.next_frame else command.consumers
        acquire(
            source,
            writer,
            channel.stop,
            limit_frames=limit,
            consumers=consumers,
            died_s=command.died_s,
            warn=warn if is_camera(command.source) else None,
        )


def _ring(command: AcquisitionCommand, source: Source) -> RingWriter:
    """Create a ring, or take over that of a process that died. Raises RingError."""
    if command.ring is not None:
        return RingWriter.take_over(command.ring, takeover_grace_s=_TAKEOVER_GRACE_S)
    slots = _slots(source.sensor, command.history_s, command.backlog_s, source.can_block)
    return RingWriter.create(
        source.sensor,
        slots=slots,
        block_frames=_BLOCK_FRAMES,
        ring_id=command.ring_id,
        takeover_grace_s=_TAKEOVER_GRACE_S,
        keeper=command.keeper,
    )


def _slots(sensor: Sensor, history_s: float, backlog_s: float, can_block: bool) -> int | None:
    """Slots of the ring; None for the default."""
    if can_block and not history_s:
        return _UNPACED_SLOTS
    slot_bytes = _BLOCK_FRAMES * sensor.compact().frame_bytes
    slots_a_second = sensor.frame_rate_hz / _BLOCK_FRAMES
    wanted = math.ceil(history_s * slots_a_second / _HISTORY_SHARE)
    if not can_block:
        # The backlog is optional, so it leaves memory for other captures.
        largest = min(MOST_BACKLOG_BYTES, shutil.disk_usage(FOLDER).free // 2)
        wanted = max(wanted, min(math.ceil(backlog_s * slots_a_second), largest // slot_bytes))
    return wanted if wanted > DEFAULT_BYTES // slot_bytes else None
