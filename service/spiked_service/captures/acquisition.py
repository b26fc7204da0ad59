"""Supervises the acquisition and preview workers of one source; used by captures and armed devices."""

import threading
import time
from pathlib import Path
from typing import Protocol

from spiked_driver.source_kinds import is_camera

from spiked.ring import CountedBefore, Ring, own_identity, remove_ring
from spiked_service.captures.ring_counts import RingCount, RingSection
from spiked_service.store.rows import Counters, Recorded
from spiked_service.workers.messages import (
    AcquisitionCommand,
    PreviewCommand,
    PreviewTaken,
    RingOpened,
    Role,
    Warned,
    WorkerError,
    WorkerEvent,
)
from spiked_service.workers.supervisor import WorkerSupervisor


class AcquisitionListener(Protocol):
    """Callbacks of an AcquisitionSupervisor, called on its threads."""

    def ring_opened(self, opened: RingOpened) -> None:
        """The ring exists; the source waits for its readers before the first frame."""

    def preview_taken(self, taken: PreviewTaken) -> None:
        """There are newer preview images."""

    def warned(self, text: str) -> None:
        """An error occurred that did not end the acquisition."""

    def acquisition_ended(self, trouble: str | None) -> None:
        """No more frames will be written; the ring can be read to its end."""

    def acquisition_finished(self) -> None:
        """The workers have exited, after `acquisition_ended`."""


class AcquisitionSupervisor:
    """Supervises acquisition and preview. Thread-safe.

    The ring keeps its name until `release`, also after its writer has exited, so that the successor of a killed reader
    can read the remaining frames.
    """

    def __init__(
        self, command: AcquisitionCommand, logs: Path, thumbnail: Path | None, listener: AcquisitionListener
    ) -> None:
        """Start the acquisition worker. Raises OSError."""
        self._command = command = command.model_copy(update={"keeper": own_identity()})
        self._thumbnail = thumbnail
        self._listener = listener
        self._lock = threading.RLock()
        self._ring: Ring | None = None
        self._opened: RingOpened | None = None
        self._picture: PreviewTaken | None = None
        self._error: str | None = None
        self._closing = False
        self._stopping = False
        self._ended = False
        self._totals: Counters | None = None
        self._section: RingSection | None = None
        self._behind: CountedBefore | None = None
        """At the stop frame of the section, once the ring has come to it."""
        self._warnings: list[str] = []
        self._acquisition = WorkerSupervisor(
            Role.ACQUISITION, logs / "acquisition.log", self._handle, self._acquisition_exited
        )
        self._preview = WorkerSupervisor(Role.PREVIEW, logs / "preview.log", self._handle_preview, self._preview_exited)
        self._acquisition.start(command)

    @property
    def opened(self) -> RingOpened | None:
        """The ring, None before it exists."""
        return self._opened

    @property
    def picture(self) -> PreviewTaken | None:
        """The newest preview images."""
        return self._picture

    @property
    def warnings(self) -> tuple[str, ...]:
        """Errors so far that did not end the acquisition."""
        return tuple(self._warnings)

    @property
    def ended(self) -> bool:
        """Whether the source is released."""
        return self._ended

    @property
    def finished(self) -> bool:
        """Whether the source is released and all workers have exited."""
        return self._ended and not self._acquisition.running and not self._preview.running

    def hand_over(self, listener: AcquisitionListener, first_frame: int, stop_frame: int | None) -> None:
        """Report to a capture from now on, which has the frames from `first_frame` to `stop_frame` of the ring."""
        with self._lock:
            self._listener = listener
            if self._ring is not None:
                attached = {one.name: one for one in Counters.of(self._ring.status()).consumers}
                self._section = RingSection(self._ring.counted_before(first_frame), stop_frame, attached)

    def ring_count(self, over: bool, recording: Recorded | None = None) -> RingCount | None:
        """What the ring has counted since it exists; None before it exists."""
        totals = self._read()
        return (
            None if totals is None else RingCount(self._command.ring_id, self._command.source, totals, over, recording)
        )

    def counters(self) -> Counters | None:
        """Counters of the ring, now or at its end; of a capture that was triggered while it ran, those of its frames.

        None before it exists.
        """
        with self._lock:
            totals, section = self._read(), self._section
            if totals is None or section is None:
                return totals
            stop = section.stop_frame
            if self._behind is None and stop is not None and totals.next_frame > stop and self._ring is not None:
                self._behind = self._ring.counted_before(stop)
            return section.of_capture(totals, self._behind)

    def _read(self) -> Counters | None:
        with self._lock:
            if self._ring is not None:
                now = Counters.of(self._ring.status())
                self._totals = now if self._section is None else self._section.of_ring(now)
            return self._totals

    def drop_readers(self, role: Role) -> None:
        """Remove readers of this role from the ring, so that the source does not wait for them."""
        with self._lock:
            if self._ring is not None:
                self._ring.remove_dead_readers(role)

    def release(self) -> None:
        """Remove the ring. The counters keep their last values."""
        with self._lock:
            self.counters()
            self._ring = None
            remove_ring(self._command.ring_id)

    def stop(self) -> None:
        """End the acquisition after the current block."""
        with self._lock:
            self._stopping = True
        if self._acquisition.cancel():
            self._end("the acquisition had died when it was stopped")
        else:
            self._acquisition.stop()

    def dismiss(self) -> None:
        """Ask the workers to exit at once."""
        with self._lock:
            self._closing = True
        self._preview.dismiss()
        if self._acquisition.dismiss():
            self._end(None)

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers; kill those that have not exited after `timeout_s`."""
        self._acquisition.join(timeout_s)
        self._preview.join(timeout_s)

    def processes(self) -> dict[str, int]:
        """Process ids of the running workers, by role."""
        pids = {Role.ACQUISITION: self._acquisition.pid, Role.PREVIEW: self._preview.pid}
        return {role: pid for role, pid in pids.items() if pid is not None}

    def _handle(self, event: WorkerEvent) -> None:
        match event:
            case RingOpened():
                with self._lock:
                    self._opened = event
                    self._ring = Ring.attach(event.name)
                    self._preview.start(
                        PreviewCommand(capture_id=self._command.capture_id, ring=event.name, thumbnail=self._thumbnail)
                    )
                self._listener.ring_opened(event)
            case Warned() if event.text not in self._warnings:  # each restarted acquisition repeats its warnings
                self._warn(event.text)
            case WorkerError():
                self._error = event.reason

    def _warn(self, text: str) -> None:
        self._warnings.append(text)
        self._listener.warned(text)

    def _acquisition_exited(self, trouble: str | None) -> None:
        died_s = time.monotonic()
        with self._lock:
            claimed = trouble is not None and self._claim_ring(trouble)
            restarted = claimed and self._acquisition.restart(self._successor(died_s))
        if restarted:
            self._warn(f"{trouble}; it was restarted, and frames in between are lost")
        else:
            self._end(f"{trouble}, repeatedly" if claimed else trouble)

    def _claim_ring(self, trouble: str) -> bool:
        """Claim the ring for a successor. Only of cameras: files and simulations can be captured again."""
        if self._closing or self._stopping or self._ring is None or not is_camera(self._command.source):
            return False
        return self._error is None and self._ring.claim_for_successor(f"{trouble}: it is being restarted")

    def _successor(self, died_s: float) -> AcquisitionCommand:
        """The command that continues the ring of an acquisition that died at `died_s` of the monotonic clock."""
        assert self._opened is not None, "its ring was claimed"
        return self._command.model_copy(update={"ring": self._opened.name, "died_s": died_s})

    def _end(self, trouble: str | None) -> None:
        """Mark the acquisition as ended and call the listener, once."""
        with self._lock:
            if self._ended:
                return
            self._acquisition.cancel()
            self._preview.cancel()
            if self._ring is not None:
                self._ring.abandon()
            self._ended = True
            reason = None if self._closing else self._error or trouble
            finished = self.finished
        self._listener.acquisition_ended(reason)
        if finished:
            self._listener.acquisition_finished()

    def _handle_preview(self, event: WorkerEvent) -> None:
        match event:
            case PreviewTaken():
                self._picture = event
                self._listener.preview_taken(event)
            case Warned() if event.text not in self._warnings:  # a restarted preview repeats its warnings
                self._warn(event.text)

    def _preview_exited(self, trouble: str | None) -> None:
        with self._lock:
            finished = self.finished
            died = trouble is not None and not self._closing and not self._ended
            restarted = died and self._preview.restart()
            if died and not restarted:
                self.drop_readers(Role.PREVIEW)
        if died:
            self._warn(f"{trouble}; {'it was restarted' if restarted else 'there is no live picture'}")
        if finished:
            self._listener.acquisition_finished()
