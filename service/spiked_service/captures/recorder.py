"""Supervises the recorder of one capture and assesses what it leaves behind."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from spiked_service.captures.recording_quality import assess, recover_and_assess
from spiked_service.store.rows import Quality, Recorded
from spiked_service.workers.messages import (
    RecorderCommand,
    RecordingEnded,
    RecordingFailed,
    Role,
    WorkerError,
    WorkerEvent,
)
from spiked_service.workers.process import StandbyWorker
from spiked_service.workers.supervisor import WorkerSupervisor


@dataclass(frozen=True)
class RecordingResult:
    """The recording of a capture after the last recorder has exited."""

    recording: Recorded | None
    """None if no recording was created."""
    verdict: Quality
    trouble: str
    """Error that ended the recording early; empty if there was none."""
    detached: bool
    """Whether the recorder detached from the ring; if not, its place in the ring must be freed."""


class RecorderListener(Protocol):
    """Callbacks of a RecorderSupervisor, called on its threads."""

    def recording_failed(self, reason: str) -> None:
        """The disk failed; the recorder counts the remaining frames as lost."""

    def warned(self, text: str) -> None:
        """The recorder died and was restarted."""

    def recording_ended(self, result: RecordingResult) -> None:
        """The recording is closed. Not called after `dismiss` if the recorder could not close it."""


class RecorderSupervisor:
    """Keeps a recorder running until it has closed the recording. Thread-safe.

    A killed recorder is replaced by a standby worker, which resumes the recording before the ring overwrites the
    frames that are missing in it.
    """

    def __init__(
        self, command: RecorderCommand, log: Path, listener: RecorderListener, standby: StandbyWorker | None = None
    ) -> None:
        """Start the recorder. Raises OSError."""
        self._command = command
        self._listener = listener
        self._closing = False
        self._report: RecordingEnded | None = None
        self._error: str | None = None
        self._worker = WorkerSupervisor(Role.RECORDER, log, self._handle, self._exited, keep_standby=True)
        self._worker.start(command, standby)

    @property
    def pid(self) -> int | None:
        """Process id of the recorder; None while none runs."""
        return self._worker.pid

    def dismiss(self) -> None:
        """Ask the recorder to exit at once."""
        self._closing = True
        self._worker.dismiss()

    def join(self, timeout_s: float) -> None:
        """Wait for a dismissed recorder; kill it after `timeout_s`."""
        self._worker.join(timeout_s)

    def _handle(self, event: WorkerEvent) -> None:
        match event:
            case RecordingFailed():
                self._listener.recording_failed(event.reason)
            case RecordingEnded():
                self._report = event
            case WorkerError():
                self._error = event.reason

    def _exited(self, trouble: str | None) -> None:
        if self._report is not None:
            self._end(_recorded(self._report))
        elif self._closing:
            return  # the next start of the service recovers the recording
        elif self._error is not None:
            self._end(self._recovered(self._error))
        elif self._worker.restart(self._resumed()):
            self._listener.warned(f"{trouble}; it was restarted and continues where it stopped")
        elif not self._closing:
            self._end(self._recovered(f"{trouble}, repeatedly"))

    def _resumed(self) -> RecorderCommand:
        """The command of a successor. A recorder killed before it created the recording leaves nothing to resume."""
        return self._command.model_copy(update={"resume": self._command.path.with_suffix(".json").exists()})

    def _recovered(self, reason: str) -> RecordingResult:
        recording, verdict = recover_and_assess(self._command.path, reason)
        return RecordingResult(recording, verdict, reason, detached=False)

    def _end(self, result: RecordingResult) -> None:
        self._worker.cancel()
        self._listener.recording_ended(result)


def _recorded(report: RecordingEnded) -> RecordingResult:
    recording = Recorded(report.frames, report.bytes, lost=sum(report.lost.values()), lost_by_cause=report.lost)
    return RecordingResult(recording, assess(report), report.trouble, detached=True)
