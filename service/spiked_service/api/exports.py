"""Published versions in the formats of other programs, and videos of recordings.

They are made in a worker process, and kept for further requests.
"""

import shutil
import threading
import time
import zlib
from pathlib import Path

from anyio import from_thread
from fastapi import Request, Response

from spiked.errors import ConfigurationError, SpikedError
from spiked.export import ExportKind, ExportOptions
from spiked.recording import open_recording
from spiked_service.api import files
from spiked_service.api.problems import NothingError, NotReadyError
from spiked_service.api.results import Result, Results
from spiked_service.base.limits import OverloadedError
from spiked_service.captures.captures import Captures
from spiked_service.store.disk_space import DiskFullError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, ReconstructionRow
from spiked_service.workers.messages import ExportCommand, VideoCommand, WorkerError, WorkerEvent
from spiked_service.workers.process import WorkerProcess
from spiked_service.workers.slow_motion import slow_motion_of

KEPT = 4
"""Files that are kept: somebody may resume a download or ask again."""
LONGEST_S = 2 * 3600.0
"""Time for an export, seconds: twice that of the largest video on two cores. Others wait for it."""
LOOK_S = 0.5
"""Interval at which it is seen whether the client still waits, seconds."""
EXIT_S = 5.0
"""Time for a worker to exit whose export is given up, seconds."""


class Exports:
    """Makes exports, one at a time, and sends them."""

    def __init__(self, results: Results, captures: Captures, folder: DataFolder) -> None:
        self._results = results
        self._captures = captures
        self._folder = folder
        self._place = folder.path / "exports"
        self._making = threading.Lock()
        shutil.rmtree(self._place, ignore_errors=True)  # of an earlier service

    def response(
        self,
        request: Request,
        row: ReconstructionRow,
        kind: ExportKind,
        options: ExportOptions,
        *,
        version: int | None,
        metric: bool,
    ) -> Response:
        """The file, or a ZIP of the folder; made now if it is not kept.

        Raises NotReadyError, NothingError, GoneError, OverloadedError while another one is made, DiskFullError, and
        ConfigurationError for what the version lacks.
        """
        kind.check()
        result = self._results.of(row, version)
        result = result.metric() if metric else result
        capture = self._captures.get(row.capture_id).row
        title = row.name or capture.name
        known = (
            row.id,
            files.stamp(result.scene),
            kind.name,
            options,
            result.frame,
            result.scale,
            title if kind.titled else "",
        )
        number = result.published.version
        made = self._place / f"{row.id}-{number:06d}-{zlib.crc32(repr(known).encode()):08x}"
        if not made.exists():
            kind.limit(result.sensor, options)
            try:
                self._make(self._command(row, capture, title, result, kind, options, made), request)
            except ConfigurationError as error:
                if result.published.splats:
                    raise
                raise NothingError(str(error)) from error  # of an early version: no other options would help
        name = f"{row.id}-{number:06d}-{kind.name}{kind.suffix or '.zip'}"
        return files.ranged(
            request, made, name, kind.sent_as, **{"X-Scene-Version": str(number)}, **result.scale_headers
        )

    def video(
        self,
        request: Request,
        capture_id: str,
        *,
        slower: float | None,
        fps: float,
        window: int,
        compensated: bool,
        begin_s: float,
        end_s: float | None,
    ) -> Response:
        """The recording of a capture in slow motion; made now if it is not kept.

        Raises UnknownIdError, NotReadyError without a closed recording, and as `response` does.
        """
        row = self._captures.get(capture_id).row
        recording = self._folder.recording(capture_id)
        if row.state.acquiring or not recording.exists():
            raise NotReadyError(f"capture {capture_id} has no closed recording")
        asked = (slower, fps, window, compensated, begin_s, end_s)
        made = self._place / f"{capture_id}-{zlib.crc32(repr((files.stamp(recording), asked)).encode()):08x}"
        if not made.exists():
            command = VideoCommand(
                capture_id=capture_id,
                recording=recording,
                out=made,
                slower=slower,
                pictures_a_second=fps,
                window=window,
                compensated=compensated,
                begin_s=begin_s,
                end_s=end_s,
            )
            slow_motion_of(command, open_recording(recording))  # refuses what is too large
            self._make(command, request)
        return files.ranged(request, made, f"{capture_id}-slow.mp4", "video/mp4")

    def _command(
        self,
        row: ReconstructionRow,
        capture: CaptureRow,
        title: str,
        result: Result,
        kind: ExportKind,
        options: ExportOptions,
        out: Path,
    ) -> ExportCommand:
        closed = capture.recording is not None and not capture.state.acquiring
        return ExportCommand(
            capture_id=row.capture_id,
            reconstruction_id=row.id,
            kind=kind.name,
            out=out,
            options=options,
            name=f"{row.id}-{result.published.version:06d}",
            title=title,
            scene=result.scene,
            poses=result.poses().path,
            white=result.published.white,
            sensor=result.sensor,
            recording=self._folder.recording(row.capture_id) if closed else None,
            first_frame=0 if capture.recording is None else capture.recording.first_frame,
            scale=result.scale,
            metric=result.frame is not None,
        )

    def _make(self, command: ExportCommand | VideoCommand, request: Request) -> None:
        """Run the worker to its end. Raises OverloadedError, also if it dies, DiskFullError and ConfigurationError."""
        if not self._making.acquire(blocking=False):
            raise OverloadedError("another export is being made; try again when it is ready")
        try:
            self._place.mkdir(exist_ok=True)
            self._tidy(KEPT - 1)
            try:
                self._run(command, request)
            except DiskFullError:
                if not self._tidy(0):
                    raise
                self._run(command, request)  # with the space of those that were kept
        finally:
            self._making.release()

    def _run(self, command: ExportCommand | VideoCommand, request: Request) -> None:
        """Run the worker to its end, at most until the client has gone or for `LONGEST_S`."""
        errors: list[SpikedError] = []
        ended = threading.Event()

        def on_event(event: WorkerEvent) -> None:
            if isinstance(event, WorkerError):
                errors.append((DiskFullError if event.disk_full else ConfigurationError)(event.reason))

        def on_exit(reason: str | None) -> None:
            if reason is not None:
                errors.append(OverloadedError(f"the export has not come to its end: {reason}"))
            ended.set()

        worker = WorkerProcess(command, self._folder.path / "exports.log", on_event, on_exit)
        deadline_s = time.monotonic() + LONGEST_S
        while not ended.wait(LOOK_S):
            late = time.monotonic() > deadline_s
            if not late and not from_thread.run(request.is_disconnected):
                continue
            worker.dismiss()
            worker.kill_after(EXIT_S)
            self._tidy(KEPT)  # of what it has begun
            if late:
                raise ConfigurationError(f"this was not ready after {LONGEST_S / 3600:g} hours: ask for less")
            raise OverloadedError("the client has closed the connection, so the export was given up")
        if errors:
            self._tidy(KEPT)  # of what a worker has begun that died
            raise errors[0]

    def _tidy(self, most: int) -> bool:
        """Keep this many files, the newest, and nothing that a worker left that was killed; whether a file went."""
        files = sorted(self._place.iterdir(), key=lambda file: file.stat().st_mtime)
        whole = [file for file in files if not file.name.startswith(".")]
        gone = whole[: max(0, len(whole) - most)]
        for file in files:
            if file.is_dir():
                shutil.rmtree(file)
            elif file in gone or file.name.startswith("."):
                file.unlink()
        return bool(gone)
