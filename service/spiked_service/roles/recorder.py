"""The recorder worker: a ring into a recording, before anything else that is done with its frames."""

import logging
import os
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recording import LIVE, RecordingWriter
from spiked.ring import Cause, End, EndReason, Frames, Gap, Policy, RingReader
from spiked_service.messages import RecorderOrder, RecordingEnded
from spiked_service.worker import Link

_log = logging.getLogger("spiked.recorder")
_WAIT_S = 0.1
_BATCH_BLOCKS = 16
"""Most that are written at once."""
_GATHER_S = 0.005
"""Blocks that come within this time are written at once, which costs the processor a third."""
_LATE_SHARE = 0.25
"""Of the ring: with more to be written, the disk is too slow, and the kernel's memory may help it out."""
_CLOCK_S = 1.0
_LOOK_S = 0.1
_NICE = -5


def run_recorder(order: RecorderOrder, link: Link) -> None:
    """Record until the end of the ring or of the capture. Trouble with the disk is told, not raised.

    Raises RecordingError if the recording cannot be begun, RingError if there is no such ring.
    """
    with suppress(PermissionError):
        os.nice(_NICE)  # before the others, whatever priority the service has
    if order.resume:
        writer = RecordingWriter.resume(order.path, durability=LIVE)
    start = order.first_frame + (writer.next_frame if order.resume else 0)
    with RingReader.attach(order.ring, Policy.PRIORITY, "recorder", start) as reader:
        if not order.resume:
            sensor = reader.geometry.sensor
            sensor = replace(sensor, intrinsics=order.intrinsics or sensor.intrinsics)
            more = {"device": {"source": order.source}}
            writer = RecordingWriter(order.path, sensor, note=order.note, durability=LIVE, **more)
        account = record(reader, writer, order.first_frame, order.stop_frame, link.stop)
    _log.info("recording closed with %d frames; lost %s", account.frames, account.lost or "none")
    link.tell(account)


def record(
    reader: RingReader, writer: RecordingWriter, first_frame: int, stop_frame: int | None, stopped: threading.Event
) -> RecordingEnded:
    """From frame `first_frame` of the ring, where the recording begins, until its end, `stop_frame` or `stopped`.

    The writer is closed. Trouble with the disk is told, not raised.
    """
    scribe = _Scribe(writer, first_frame, reader)
    end = None
    try:
        end = _record(reader, scribe, stop_frame, stopped)
    except RecordingError as error:
        scribe.trouble = str(error)
    try:
        writer.close()
    except RecordingError as error:
        scribe.trouble = scribe.trouble or str(error)
    return scribe.account(end)


class _Scribe:
    """Collects blocks that wait, writes them in order, and notes losses, clocks, and whether there is any light."""

    def __init__(self, writer: RecordingWriter, first_frame: int, reader: RingReader) -> None:
        self.writer = writer
        self.trouble = ""
        self._first = first_frame
        geometry = reader.geometry
        shape = (_BATCH_BLOCKS * geometry.block_frames, geometry.sensor.frame_bytes)
        self._buffer: NDArray[np.uint8] = np.empty(shape, np.uint8)
        self._waiting = 0
        self._due_s = 0.0
        self._reader = reader
        self._late_frames = _LATE_SHARE * geometry.slots * geometry.block_frames
        self._clock_s = self._looked_s = -np.inf
        self._fired = self._unfired = False

    @property
    def next_frame(self) -> int:
        """Index in the ring of the next frame."""
        return self._first + self.writer.next_frame + self._waiting

    @property
    def patience_s(self) -> float:
        """How long what waits to be written may wait for more."""
        return max(0.0, self._due_s - time.monotonic()) if self._waiting else _WAIT_S

    @property
    def has_room(self) -> bool:
        return self._waiting + len(self._buffer) // _BATCH_BLOCKS <= len(self._buffer)

    def take(self, item: Frames, stop: int | None) -> None:
        """Copy what belongs to the capture out of the ring; what was overwritten meanwhile comes again as a gap."""
        begin = max(0, self.next_frame - item.first)
        end = item.count if stop is None else min(item.count, stop - item.first)
        if end <= begin:
            return
        place = self._buffer[self._waiting : self._waiting + end - begin]
        place[:] = item.data[begin:end]
        if item.release():
            self._due_s = self._due_s if self._waiting else time.monotonic() + _GATHER_S
            self._waiting += end - begin

    def write(self) -> None:
        """Hand over what waits. Raises RecordingError."""
        frames = self._buffer[: self._waiting]
        if not len(frames):
            return
        now_s = time.monotonic()
        if now_s - self._clock_s > _CLOCK_S:
            self._clock_s = now_s
            self.writer.clock_pair(self.writer.next_frame + len(frames) - 1, time.time_ns())
        if now_s - self._looked_s > _LOOK_S:
            self._looked_s = now_s
            self._fired = self._fired or bool(frames[-1].any())
            self._unfired = self._unfired or bool((frames[-1] != 0xFF).any())
        late = self._reader.newest_frame - self.next_frame > self._late_frames
        self._waiting = 0
        self.writer.append(frames, cached=late)

    def lose(self, gap: Gap, cause: Cause, stop: int | None) -> None:
        """Note a loss, as far as it lies within the capture. Raises RecordingError."""
        self.write()
        end = gap.first + gap.count if stop is None else min(gap.first + gap.count, stop)
        count = end - max(gap.first, self.next_frame)
        if count > 0:
            self.writer.gap(self.writer.next_frame, count, cause)

    def account(self, end: End | None) -> RecordingEnded:
        lost: Counter[str] = Counter()
        for gap in self.writer.gaps:
            lost[gap.cause] += gap.count
        looked = self._fired or self._unfired
        return RecordingEnded(
            frames=self.writer.frames,
            bytes=self.writer.bytes,
            lost=dict(lost),
            trouble=self.trouble,
            dark=looked and not self._fired,
            saturated=looked and not self._unfired,
            died=end is not None and end.reason is EndReason.WRITER_DIED,
        )


def _record(reader: RingReader, scribe: _Scribe, stop: int | None, stopped: threading.Event) -> End | None:
    """Until the end of the ring, the capture's last frame, or the service's wish. Raises RecordingError."""
    overruns = reader.overruns
    while not stopped.is_set() and (stop is None or scribe.next_frame < stop):
        item = reader.next(scribe.patience_s)
        match item:
            case Frames():
                scribe.take(item, stop)
                if not scribe.has_room:
                    scribe.write()
            case Gap():
                # What this reader was too slow for, the disk was too slow for.
                own = reader.overruns > overruns
                overruns = reader.overruns
                scribe.lose(item, Cause.DISK if own else item.cause, stop)
            case None:
                scribe.write()
            case End():
                scribe.write()
                return item
    scribe.write()
    return None
