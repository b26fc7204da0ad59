"""The reconstruction worker: feeds frames to a `Reconstructor` and publishes its versions in a folder."""

import logging
import math
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.calibration import Calibration
from spiked.camera import MosaicChoice
from spiked.errors import CheckpointError, SceneError
from spiked.recon import NotOnePlaceError, Options, Reconstructor, State, extend
from spiked.recon.checkpoint import CheckpointSaver, Interrupted
from spiked.recon.checkpoint_file import CHECKPOINT, exists
from spiked.recon.frontend.windowing import SEARCH_FRAMES
from spiked.recording import Recording, open_recording, recorded_calibration
from spiked.ring import End, Frames, Gap, Policy, RingReader
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory
from spiked_service.results.mosaic_by_pixels import by_pixels
from spiked_service.results.pinned_map import PinnedMap
from spiked_service.results.recording_feed import pieces
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.frame_skipping import (
    LATE_FRAMES,
    LONGEST_UNMAPPED_S,
    LatestFrames,
    WindowChooser,
    may_map,
    may_sweep,
)
from spiked_service.workers.messages import ReconstructionCommand
from spiked_service.workers.progress_reporter import ProgressReporter

_log = logging.getLogger("spiked.reconstruction")
_WAIT_S = 0.05
"""Longest wait for frames, seconds."""
_SPARE_S = 0.1
"""Mapping time per step while no frames wait; short compared with the time that the ring buffers."""
_UNPACED_FRAMES = 32
"""Frames between two times of mapping, of a source that can block."""
_UNPACED_MAPPING_S = 0.3
"""Mapping time after every `_UNPACED_FRAMES` frames of a source that can block."""
_SKIPPING_MAPPING_S = 0.01
"""Mapping time between two windows of a skipping tracker: one or two steps."""
_LIVE_NICE = 5
"""Mapping uses all cores; acquisition and rendering of views have priority."""
_OFFLINE_NICE = 10
"""Niceness of a reconstruction from a recording: live captures have priority."""


def run_reconstruction(command: ReconstructionCommand, channel: WorkerChannel) -> None:
    """Track and map the frames, refine at the end, and publish versions meanwhile.

    Raises ConfigurationError, RecordingError or RingError for errors that the user can correct, SceneError if a version
    cannot be written.
    """
    with ExitStack() as ended:  # what is being written is finished and told, however the work ends
        _run(command, channel, ended)


def _run(command: ReconstructionCommand, channel: WorkerChannel, ended: ExitStack) -> None:
    if command.ring is not None:
        os.nice(_LIVE_NICE)
        # Readers of a source that can block are never overrun. Of others, the tracker reads as far back as possible.
        policy = Policy.LOSSLESS if command.can_block else Policy.PRIORITY
        with RingReader.attach(command.ring, policy, "reconstruction", command.first_frame) as reader:
            work = _begin(command, reader.geometry.sensor, channel)
            ended.callback(work.reporter.close)
            skipped = _follow(reader, work, command)
            pathless = work.reconstructor.status().state is State.BOOT
            if skipped and not command.recorded and pathless and not channel.stop.is_set():
                work = _track_ring_again(reader, work, command)
                ended.callback(work.reporter.close)
        if skipped and command.recorded:
            work.adjust_path()
            work.reporter.frames_skipped(skipped)
            return
    else:
        assert command.recording is not None, "a command has a ring or a recording"
        os.nice(_OFFLINE_NICE)  # live captures have priority
        recording = open_recording(command.recording, **command.options.geometry())
        saver = CheckpointSaver(command.folder / CHECKPOINT, recording, _parameters(command), _log.warning)
        work = _resume(command, channel, recording) or _begin(command, recording.sensor, channel, recording)
        work = replace(work, checkpoints=saver, deadline=_deadline(command, work.reconstructor))
        work.reconstructor.expect(recording.capture_index(recording.frames - 1) + 1)
        _read(recording, work)
    if command.ring is not None and command.options.seconds is not None:
        work = replace(work, deadline=time.monotonic() + command.options.seconds)
    work.finish()
    if command.map is not None:
        work.extend(command.map)
    work.end()


@dataclass(frozen=True)
class _Work:
    reconstructor: Reconstructor
    reporter: ProgressReporter
    channel: WorkerChannel
    checkpoints: CheckpointSaver | None = None
    """Of a reconstruction from a recording."""
    deadline: float = math.inf
    """When its time budget is over, on the monotonic clock."""

    def save(self) -> None:
        """Save a checkpoint if one is due, or if the worker is to exit."""
        if self.checkpoints is not None:
            self.checkpoints.save(self.reconstructor, now=self.channel.leave.is_set())

    def feed(self, first: int, frames: NDArray[np.uint8], newest: Callable[[], int] | None = None) -> None:
        """`newest` returns the number of frames captured so far; None if they are not from a camera."""
        self.reconstructor.feed(first, frames)
        self.reporter.tracked(newest and newest() - first - len(frames))

    def track_latest(self, first: int, frames: NDArray[np.uint8], newest: Callable[[], int]) -> None:
        self.reconstructor.track_latest(first, frames)
        self.reporter.tracked(newest() - first - len(frames))

    def is_over(self) -> bool:
        """The worker is to exit or to stop."""
        return self.channel.leave.is_set() or self.channel.stop.is_set()

    def adjust_path(self) -> None:
        """Close the loops of a path that is computed again from the recording, unless the worker is to stop."""
        if self.reconstructor.path is not None:
            os.nice(_OFFLINE_NICE - _LIVE_NICE)
            self.reconstructor.end_tracking(self.reporter.progress, self.is_over, preliminary=True)

    def finish(self) -> None:
        """Refine, publish and report the end, unless the worker is to exit: then the job restarts later."""
        leave, stop = self.channel.leave, self.channel.stop
        progress = self.reporter.progress
        self.reporter.refine()
        self.reconstructor.finish(
            lambda status: None if leave.is_set() else progress(status),
            self.is_over,
            budget_s=None if self.deadline == math.inf else max(0.0, self.deadline - time.monotonic()),
            save=self.save,
        )
        if not leave.is_set():
            self.reporter.last(cut_short=stop.is_set())

    def extend(self, folder: Path) -> None:
        """Join the map in a folder with what was reconstructed, unless the worker is to stop or found no path."""
        stop = self.channel.stop
        if stop.is_set() or self.reconstructor.failure is not None:
            return
        if self.checkpoints is not None:
            self.checkpoints.save(self.reconstructor, now=True)  # the refinement is not repeated after a kill
        about = PinnedMap.read(folder)
        try:
            made = extend(about.known(folder), self.reconstructor, self.reporter.joining, stop.is_set)
        except (NotOnePlaceError, SceneError) as error:
            self.reporter.not_joined(str(error))
            return
        if not stop.is_set():
            self.reporter.joined(made, about.recorded(folder))

    def end(self) -> None:
        """The work is complete, unless the worker is to exit: its checkpoint is not needed any more."""
        if self.checkpoints is not None and not self.channel.leave.is_set():
            self.checkpoints.remove()

    def lose(self, first: int, count: int, cause: str) -> None:
        self.reconstructor.gap(first, count)
        self.reporter.lost(first, count, cause)


def _begin(
    command: ReconstructionCommand, sensor: Sensor, channel: WorkerChannel, recording: Recording | None = None
) -> _Work:
    live = command.ring is not None and not command.can_block
    sensor = command.options.sensor(sensor, command.intrinsics)
    questions = list(command.questions if recording is None else recording.questions)
    if command.options.mosaic is MosaicChoice.AUTO:
        sensor, question = _detected(sensor, recording)
        questions += [] if question is None else [question]
    reconstructor = Reconstructor(sensor, options_of(command, recording), live=live, recording=recording)
    reconstructor.warnings += questions
    return _Work(reconstructor, ProgressReporter(reconstructor, command, channel), channel)


def _detected(sensor: Sensor, recording: Recording | None) -> tuple[Sensor, str | None]:
    if recording is None:
        return sensor, "the mosaic is detected from recordings only: reconstruct this capture again to have it detected"
    return by_pixels(recording, sensor)


def _deadline(command: ReconstructionCommand, reconstructor: Reconstructor) -> float:
    """End of what an earlier worker has left of the time budget, on the monotonic clock."""
    budget_s = command.options.seconds
    return math.inf if budget_s is None else time.monotonic() + max(0.0, budget_s - reconstructor.work_s)


def options_of(command: ReconstructionCommand, recording: Recording | None) -> Options:
    """The options for the library, with the calibration of the camera and given poses.

    Raises CalibrationError and SceneError.
    """
    path = command.calibration or (None if recording is None else recorded_calibration(recording.path))
    measured = None if path is None else Calibration.read(path)
    poses = None if command.poses is None else Trajectory.read_tum(command.poses)
    return replace(command.options.options(), calibration=measured, poses=poses)


def _parameters(command: ReconstructionCommand) -> dict[str, Any]:
    """What a resumed reconstruction must have in common with the one before."""
    return command.model_dump(mode="json", include={"options", "intrinsics"})


def _resume(command: ReconstructionCommand, channel: WorkerChannel, recording: Recording) -> _Work | None:
    """The work of an earlier worker as its last checkpoint has it; None without one that can be used."""
    folder = command.folder / CHECKPOINT
    if not exists(folder):
        return None
    try:
        interrupted = Interrupted.read(folder)
        if interrupted.parameters != _parameters(command):
            raise CheckpointError(f"{folder}: it was begun with other options")
        reconstructor = interrupted.resume(recording)
    except CheckpointError as error:
        _log.warning("the reconstruction begins anew: %s", error)
        return None
    _log.info("resumed from its checkpoint: %s", interrupted.stage)
    return _Work(reconstructor, ProgressReporter(reconstructor, command, channel, resumed=True), channel)


def _follow(reader: RingReader, work: _Work, command: ReconstructionCommand, may_skip: bool = True) -> int:
    """Process frames and gaps to the end of the capture. Return the number of frames skipped to keep up."""
    mapped_to = 0
    zero, stop = command.first_frame, command.stop_frame

    def newest() -> int:
        return _within(0, reader.newest_frame, 0, stop)[1] - zero

    while not work.channel.leave.is_set():
        item = reader.next(_WAIT_S)
        match item:
            case End():
                return 0
            case Gap():
                begin, end = _within(item.first, item.first + item.count, zero, stop)
                if end > begin:
                    work.lose(begin - zero, end - begin, item.cause)
            case Frames():
                copied = np.array(item.data)
                begin, end = _within(item.first, item.first + item.count, zero, stop)
                if item.release() and end > begin:
                    part = copied[begin - item.first : end - item.first]
                    work.feed(begin - zero, part, None if command.can_block else newest)
                if command.can_block and item.first - mapped_to >= _UNPACED_FRAMES:
                    mapped_to = item.first
                    work.reconstructor.improve(_UNPACED_MAPPING_S)
                elif may_skip and not command.can_block and newest() + zero - end > LATE_FRAMES:
                    return _track_latest(LatestFrames(reader, end), work, command, newest)
            case None:
                work.reconstructor.improve(_SPARE_S)
        if stop is not None and isinstance(item, Gap | Frames) and item.first + item.count >= stop:
            return 0
        work.reporter.progress(work.reconstructor.status())
    return 0


def _track_latest(latest: LatestFrames, work: _Work, command: ReconstructionCommand, newest: Callable[[], int]) -> int:
    """Track windows of the newest frames to the end of the capture. Return the number of frames skipped."""
    zero, stop = command.first_frame, command.stop_frame
    reconstructor = work.reconstructor
    rate_hz = reconstructor.sensor.frame_rate_hz
    windows = WindowChooser(rate_hz, latest.backlog_frames / rate_hz)
    mapped_s = time.monotonic()
    while not work.channel.leave.is_set() and (stop is None or latest.at < stop):
        count = reconstructor.latest_frames
        latest.track_latest(windows.next(latest.at, newest() + zero, count, reconstructor.speed_px), count)
        while (item := latest.take(_WAIT_S)) is None and not work.channel.leave.is_set():
            reconstructor.improve(_SPARE_S)
            mapped_s = time.monotonic()
        match item:
            case End():
                break
            case Gap():
                begin, end = _within(item.first, item.first + item.count, zero, stop)
                if end > begin:
                    work.lose(begin - zero, end - begin, item.cause)
            case (begin, frames):
                taken_s = time.monotonic()
                frames = frames[max(0, zero - begin) :]
                begin = max(begin, zero)
                end = _within(begin, begin + len(frames), zero, stop)[1]
                if end - begin > SEARCH_FRAMES:
                    work.track_latest(begin - zero, frames[: end - begin], newest)
                late = newest() + zero - end
                overdue = time.monotonic() - mapped_s > LONGEST_UNMAPPED_S
                if overdue or may_map(late, reconstructor.speed_px, rate_hz):
                    reconstructor.improve(_SKIPPING_MAPPING_S)
                    mapped_s = time.monotonic()
                elif may_sweep(late, reconstructor.speed_px):
                    reconstructor.sweep_behind()
                windows.took(time.monotonic() - taken_s)
        work.reporter.progress(reconstructor.status())
    return latest.skipped


def _track_ring_again(reader: RingReader, work: _Work, command: ReconstructionCommand) -> _Work:
    """Track all frames that the ring still holds, of a capture that is not recorded and has no trajectory yet."""
    with reader.another(Policy.PRIORITY, "reconstruction again", command.first_frame) as behind:
        again = _begin(command, reader.geometry.sensor, work.channel)
        _follow(behind, again, command, may_skip=False)
    return again


def _within(first: int, last: int, begin: int, stop: int | None) -> tuple[int, int]:
    return max(first, begin), last if stop is None else min(last, stop)


def _read(recording: Recording, work: _Work) -> None:
    """Process a whole recording with its gaps, or what a checkpoint leaves of it."""
    causes = {gap.first: gap.cause for gap in recording.gaps}
    expected = work.reconstructor.frames
    for piece in pieces(recording, begin=expected):
        if work.reconstructor.frames:
            work.save()
        if work.channel.stop.is_set():
            return
        if time.monotonic() > work.deadline:
            work.reconstructor.warnings.append(
                f"the time was over after {expected:,} frames, and the others are left out: raise seconds"
            )
            return
        if piece.index > expected:
            work.lose(expected, piece.index - expected, causes.get(expected, "unknown"))
        # Stored frames may contain row numbers; the reconstructor decodes them by the sensor.
        work.feed(piece.index, np.array(recording.read(piece.first, piece.count)))
        expected = piece.index + piece.count
        work.reporter.progress(work.reconstructor.status())
