"""The recorder worker: writes the frames of a ring into a recording, with priority over all other readers."""

import logging
import os
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recording import LIVE, RecordingWriter
from spiked.recording.sidecar import lost_by_cause
from spiked.ring import ClockPair, End, EndReason, Frames, Gap, LossCause, Policy, RingReader
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import RecorderCommand, RecordingEnded, RecordingFailed

_log = logging.getLogger("spiked.recorder")
_WAIT_S = 0.1
"""Longest wait for frames, seconds."""
_BATCH_BLOCKS = 16
"""Most blocks per write."""
_GATHER_S = 0.005
"""Blocks received within this time are written together, which takes a third of the CPU time."""
_LATE_SHARE = 0.25
"""Share of the ring: with a larger backlog, writes go through the page cache."""
_CLOCK_NS = 1_000_000_000
"""Least time between two clock pairs in the index, ns."""
_LOOK_S = 0.1
"""Interval at which a frame is checked for spikes, seconds: a stream of only zeros or only ones is no picture."""
_DRAIN_S = 0.5
"""Time to wait for the last frames after a stop."""
CALIBRATION = "calibration.npz"
"""Name of the calibration beside a recording."""
_NICE = -5
"""Niceness: above the other readers."""


def run_recorder(command: RecorderCommand, channel: WorkerChannel) -> None:
    """Record until the end of the ring or of the capture. Disk errors are sent as events, not raised.

    Raises RecordingError if the recording cannot be created, RingError if there is no such ring.
    """
    with suppress(PermissionError):
        os.nice(_NICE)  # above the other readers, whatever priority the service has
    if command.resume:
        writer = RecordingWriter.resume(command.path, durability=LIVE)
    start = command.first_frame + (writer.next_frame if command.resume else 0)
    with RingReader.attach(command.ring, Policy.PRIORITY, "recorder", start) as reader:
        if not command.resume:
            sensor = reader.geometry.sensor
            sensor = replace(sensor, intrinsics=command.intrinsics or sensor.intrinsics)
            more = {"device": {"source": command.source}, **_camera_fields(command)}
            writer = RecordingWriter(command.path, sensor, note=command.note, durability=LIVE, **more)
        account = record(
            reader,
            writer,
            command.first_frame,
            command.stop_frame,
            channel.stop,
            lambda trouble: channel.send(RecordingFailed(reason=trouble)),
        )
    _log.info("recording closed with %d frames; lost %s", account.frames, account.lost or "none")
    channel.send(account)


def _camera_fields(command: RecorderCommand) -> dict[str, Any]:
    """Fields of the sidecar from what is known of the camera; its calibration is copied beside the recording.

    Raises RecordingError if it cannot be copied.
    """
    fields: dict[str, Any] = {"assumed": command.assumed}
    if command.profile is not None:
        fields["profile"] = command.profile.model_dump(mode="json", exclude_defaults=True)
    if command.calibration is not None:
        copy = command.path.with_name(CALIBRATION)
        try:
            shutil.copyfile(command.calibration, copy)
        except OSError as error:
            raise RecordingError(
                f"the calibration {command.calibration} cannot be copied to {copy}: {error.strerror}; free disk space"
            ) from error
        fields["calibration"] = CALIBRATION
    return fields


def record(
    reader: RingReader,
    writer: RecordingWriter,
    first_frame: int,
    stop_frame: int | None,
    stopped: threading.Event,
    on_trouble: Callable[[str], None] = lambda trouble: None,
) -> RecordingEnded:
    """Record frames `first_frame` to `stop_frame` of the ring, or to its end, and close the writer.

    After `stopped` is set, wait at most `_DRAIN_S` for further frames. Disk errors are not raised: `on_trouble` is
    called at the first, and all later frames count as lost to the disk.
    """
    buffer = RecordingBuffer(writer, first_frame, reader, on_trouble)
    end = _record(reader, buffer, stop_frame, stopped)
    buffer.finish()
    try:
        writer.close()
    except RecordingError as error:
        buffer.trouble = buffer.trouble or str(error)
    return buffer.account(end)


class RecordingBuffer:
    """Buffers blocks and writes them in order; records losses and clock pairs; detects dark and saturated captures."""

    def __init__(
        self, writer: RecordingWriter, first_frame: int, reader: RingReader, on_trouble: Callable[[str], None]
    ) -> None:
        self.writer = writer
        self.trouble = ""
        """First disk error; all later frames count as lost to the disk."""
        self._on_trouble = on_trouble
        self._first = first_frame
        geometry = reader.geometry
        shape = (_BATCH_BLOCKS * geometry.block_frames, geometry.sensor.frame_bytes)
        self._buffer: NDArray[np.uint8] = np.empty(shape, np.uint8)
        self._waiting = 0
        self._due_s = 0.0
        self._reader = reader
        self._late_frames = _LATE_SHARE * geometry.slots * geometry.block_frames
        self._pair: ClockPair | None = None  # not written: less than `_CLOCK_NS` after the last one
        self._looked_s = -np.inf
        self._fired = self._unfired = False

    @property
    def next_frame(self) -> int:
        """Ring index of the next frame."""
        return self._first + self.writer.next_frame + self._waiting

    @property
    def patience_s(self) -> float:
        """Time to wait for more blocks before the next write."""
        return max(0.0, self._due_s - time.monotonic()) if self._waiting else _WAIT_S

    @property
    def has_space(self) -> bool:
        return self._waiting + len(self._buffer) // _BATCH_BLOCKS <= len(self._buffer)

    def take(self, item: Frames, stop: int | None) -> None:
        """Copy the frames of the capture from the ring. Frames overwritten meanwhile follow as a gap."""
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
        """Write the buffer; frames that cannot be written count as lost to the disk."""
        frames = self._buffer[: self._waiting]
        if not len(frames):
            return
        if not self.trouble:
            try:
                self._append(frames)
            except RecordingError as error:
                self._fail(error)
        self._waiting = 0
        if self.trouble:
            self._gap(len(frames), LossCause.DISK)

    def _append(self, frames: NDArray[np.uint8]) -> None:
        now_s = time.monotonic()
        if now_s - self._looked_s > _LOOK_S:
            self._looked_s = now_s
            self._fired = self._fired or bool(frames[-1].any())
            self._unfired = self._unfired or bool((frames[-1] != 0xFF).any())
        late = self._reader.newest_frame - self.next_frame > self._late_frames
        self.writer.append(frames, cached=late)

    def note(self, pair: ClockPair) -> None:
        """Record the host time of a frame, at most once a second."""
        frame = pair.frame - self._first
        last = self.writer.clock[-1] if self.writer.clock else None
        if not (0 if last is None else last.frame + 1) <= frame < self.next_frame - self._first:
            return  # outside the recording, or written by an earlier recorder
        self._pair = ClockPair(frame, pair.unix_ns)
        if last is None or pair.unix_ns - last.unix_ns >= _CLOCK_NS:
            self.finish()

    def finish(self) -> None:
        """Write the last clock pair."""
        if self._pair is not None:
            try:
                self.writer.clock_pair(self._pair.frame, self._pair.unix_ns)
            except RecordingError as error:  # missing in the index; the sidecar is written at the end
                self._fail(error)
            self._pair = None

    def _gap(self, count: int, cause: LossCause) -> None:
        try:
            self.writer.gap(self.writer.next_frame, count, cause)
        except RecordingError as error:  # as above
            self._fail(error)

    def _fail(self, error: RecordingError) -> None:
        if not self.trouble:
            self.trouble = str(error)
            self._on_trouble(self.trouble)

    def lose(self, gap: Gap, cause: LossCause, stop: int | None) -> None:
        """Record a loss, clipped to the capture."""
        self.write()
        end = gap.first + gap.count if stop is None else min(gap.first + gap.count, stop)
        count = end - max(gap.first, self.next_frame)
        if count > 0:
            self._gap(count, cause)

    def account(self, end: End | None) -> RecordingEnded:
        looked = self._fired or self._unfired
        return RecordingEnded(
            frames=self.writer.frames,
            bytes=self.writer.bytes,
            lost=lost_by_cause(self.writer.gaps),
            trouble=self.trouble,
            dark=looked and not self._fired,
            saturated=looked and not self._unfired,
            died=end is not None and end.reason is EndReason.WRITER_DIED,
        )


def _record(reader: RingReader, buffer: RecordingBuffer, stop: int | None, stopped: threading.Event) -> End | None:
    """Record to the end of the ring, the last frame of the capture, or `_DRAIN_S` after `stopped`."""
    overruns = reader.overruns
    leave_s = np.inf
    while time.monotonic() < leave_s and (stop is None or buffer.next_frame < stop):
        if stopped.is_set():
            leave_s = min(leave_s, time.monotonic() + _DRAIN_S)
        item = reader.next(buffer.patience_s)
        for pair in reader.clock_pairs():
            buffer.note(pair)
        match item:
            case Frames():
                buffer.take(item, stop)
                if not buffer.has_space:
                    buffer.write()
            case Gap():
                # An overrun of this reader means that the disk was too slow.
                own = reader.overruns > overruns
                overruns = reader.overruns
                buffer.lose(item, LossCause.DISK if own else item.cause, stop)
            case None:
                buffer.write()
            case End():
                buffer.write()
                return item
    buffer.write()
    return None
