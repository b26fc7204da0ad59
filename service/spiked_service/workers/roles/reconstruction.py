"""The reconstruction worker: feeds frames to a `Reconstructor` and publishes its versions in a folder."""

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.calibration import Calibration
from spiked.errors import CheckpointError, SceneError
from spiked.pose import quaternion
from spiked.poses import PoseFile
from spiked.recon import Options, Reconstructor, State, Status, Tracked
from spiked.recon.checkpoint import CHECKPOINT, CheckpointSaver, Interrupted, exists
from spiked.recon.frontend.windowing import SEARCH_FRAMES
from spiked.recording import Recording, open_recording, recorded_calibration
from spiked.ring import End, Frames, Gap, Policy, RingReader
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked_service.events.payloads import PosePayload
from spiked_service.results.recording_feed import pieces
from spiked_service.results.shown_scene import TOLERANCE
from spiked_service.results.timeline import frames_at
from spiked_service.results.timeline_writer import TimelineWriter
from spiked_service.results.versions import Published, Publisher, pose_file
from spiked_service.store.rows import Stage
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.frame_skipping import LATE_FRAMES, LatestFrames, next_window
from spiked_service.workers.messages import (
    FramesSkipped,
    PoseEstimated,
    ReconstructionCommand,
    ReconstructionStatus,
    VersionPublished,
)

_log = logging.getLogger("spiked.reconstruction")
_WAIT_S = 0.05
"""Longest wait for frames, seconds."""
_SPARE_S = 0.1
"""Mapping time per step while no frames wait; short compared with the time that the ring buffers."""
_UNPACED_FRAMES = 32
"""Frames between two times of mapping, of a source that can block."""
_UNPACED_MAPPING_S = 0.3
"""Mapping time after every `_UNPACED_FRAMES` frames of a source that can block."""
_PUBLISH_S = 1.5
"""Least time between two published versions, seconds."""
_PUBLISH_SHARE = 0.1
"""Largest share of the time spent on publishing: trajectories of minutes take seconds to write."""
_STATUS_S = 0.2
"""Interval of status events, seconds."""
_PUNCTUAL_S = 0.04
"""Lateness up to which the mapper runs after every window of a skipping tracker, ..."""
_MOST_UNMAPPED = 4
"""... and the number of windows after which it runs otherwise."""
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
    if command.ring is not None:
        os.nice(_LIVE_NICE)
        # Readers of a source that can block are never overrun. Of others, the tracker reads as far back as possible.
        policy = Policy.LOSSLESS if command.can_block else Policy.PRIORITY
        with RingReader.attach(command.ring, policy, "reconstruction", command.first_frame) as reader:
            work = _begin(command, reader.geometry.sensor, channel)
            skipped = _follow(reader, work, command)
            if skipped and command.recorded:
                work.reporter.frames_skipped(skipped)
                return
            if skipped and work.reconstructor.status().state is State.BOOT and not channel.stop.is_set():
                work = _track_ring_again(reader, work, command)
    else:
        assert command.recording is not None, "a command has a ring or a recording"
        os.nice(_OFFLINE_NICE)  # live captures have priority
        recording = open_recording(command.recording)
        saver = CheckpointSaver(command.folder / CHECKPOINT, recording, _parameters(command), _log.warning)
        work = _resume(command, channel, recording) or _begin(command, recording.sensor, channel, recording)
        work = replace(work, checkpoints=saver)
        work.reporter.expect(recording.capture_index(recording.frames - 1) + 1)
        _read(recording, work)
    work.finish()


@dataclass(frozen=True)
class _Work:
    reconstructor: Reconstructor
    reporter: "ProgressReporter"
    channel: WorkerChannel
    checkpoints: CheckpointSaver | None = None
    """Of a reconstruction from a recording."""

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

    def finish(self) -> None:
        """Refine, publish and report the end, unless the worker is to exit: then the job restarts later."""
        leave, stop = self.channel.leave, self.channel.stop
        progress = self.reporter.progress
        self.reporter.refine()
        self.reconstructor.finish(
            lambda status: None if leave.is_set() else progress(status),
            lambda: leave.is_set() or stop.is_set(),
            save=self.save,
        )
        if not leave.is_set():
            self.reporter.last(cut_short=stop.is_set())
            if self.checkpoints is not None:
                self.checkpoints.remove()

    def lose(self, first: int, count: int, cause: str) -> None:
        self.reconstructor.gap(first, count)
        self.reporter.lost(first, count, cause)


def _begin(
    command: ReconstructionCommand, sensor: Sensor, channel: WorkerChannel, recording: Recording | None = None
) -> _Work:
    intrinsics: Intrinsics | None = command.intrinsics or sensor.intrinsics
    live = command.ring is not None and not command.can_block
    options = options_of(command, recording)
    reconstructor = Reconstructor(replace(sensor, intrinsics=intrinsics), options, live=live, recording=recording)
    return _Work(reconstructor, ProgressReporter(reconstructor, command, channel), channel)


def options_of(command: ReconstructionCommand, recording: Recording | None) -> Options:
    """The options for the library, with the calibration of the camera. Raises CalibrationError."""
    path = command.calibration if recording is None else recorded_calibration(recording.path)
    measured = None if path is None else Calibration.read(path)
    return replace(command.options.options(), calibration=measured)


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
    unmapped = 0
    while not work.channel.leave.is_set() and (stop is None or latest.at < stop):
        count = reconstructor.latest_frames
        first = next_window(latest.at, newest() + zero, count, reconstructor.speed_px, rate_hz)
        latest.track_latest(first, count)
        while (item := latest.take(_WAIT_S)) is None and not work.channel.leave.is_set():
            reconstructor.improve(_SPARE_S)
        match item:
            case End():
                break
            case Gap():
                begin, end = _within(item.first, item.first + item.count, zero, stop)
                if end > begin:
                    work.lose(begin - zero, end - begin, item.cause)
            case (begin, frames):
                frames = frames[max(0, zero - begin) :]
                begin = max(begin, zero)
                end = _within(begin, begin + len(frames), zero, stop)[1]
                if end - begin > SEARCH_FRAMES:
                    work.track_latest(begin - zero, frames[: end - begin], newest)
                unmapped += 1
                if newest() + zero - end < _PUNCTUAL_S * rate_hz or unmapped >= _MOST_UNMAPPED:
                    unmapped = 0
                    reconstructor.improve(_SKIPPING_MAPPING_S)
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
        if piece.index > expected:
            work.lose(expected, piece.index - expected, causes.get(expected, "unknown"))
        # Stored frames may contain row numbers; the reconstructor decodes them by the sensor.
        work.feed(piece.index, np.array(recording.read(piece.first, piece.count)))
        expected = piece.index + piece.count
        work.reporter.progress(work.reconstructor.status())


class ProgressReporter:
    """Sends progress to the service, publishes versions at limited rates, and writes the timeline."""

    def __init__(
        self,
        reconstructor: Reconstructor,
        command: ReconstructionCommand,
        channel: WorkerChannel,
        resumed: bool = False,
    ) -> None:
        self._reconstructor = reconstructor
        self._publisher = Publisher(command.folder)
        views = len(reconstructor.views)
        self._timeline = TimelineWriter(command.folder, views, reconstructor.frames)
        self._channel = channel
        self._sent_s = self._published_s = -np.inf
        self._seen = 0
        self._tracked = self._timeline.moments
        versions = self._publisher.versions if resumed else []
        self._poses = versions[-1].poses if versions else 0
        self._pause_s = _PUBLISH_S
        self._least_poses = command.least_poses
        self._continues = resumed or command.least_poses > 0
        """Versions of earlier workers belong to this run of the reconstruction."""
        self._own = self._publisher.version + 1
        """First version of this worker."""
        self._candidates: set[int] = set()
        """Versions that the last one is compared with, see `_best`."""
        self._refines = False
        self._begun_s = time.monotonic()
        self._refining_s: float | None = None
        self._expected: int | None = None
        self._state = State.BOOT

    def expect(self, frames: int) -> None:
        """Set the number of frames, for the estimate of the remaining time."""
        self._expected = frames

    def lost(self, first: int, count: int, cause: str) -> None:
        self._timeline.lost(first, count, cause)

    def tracked(self, latency_frames: int | None) -> None:
        """Send the poses of the views tracked since the last call."""
        new = self._reconstructor.tracked(self._tracked)
        self._tracked += len(new)
        if not new:
            return
        status = self._reconstructor.status()
        for view in new:
            self._timeline.tracked(view, status, _psnr_db(status.loss))
            if view.rotation is not None and view.centre is not None:
                self._channel.try_send(PoseEstimated(pose=self._pose(view, status, latency_frames)))

    def progress(self, status: Status) -> None:
        now_s = time.monotonic()
        if status.state is not self._state:
            _log.info(
                "%s after %d frames%s", status.state, status.frames, f": {status.reason}" if status.reason else ""
            )
            self._state = status.state
        if self._refines and status.stage == Stage.REFINING:
            self._refines = False
            if status.splats:  # the map and the whole trajectory as tracked
                self._publish(status)
                self._hold()
        if status.version != self._seen and now_s - self._published_s > self._pause_s:
            self._publish(status)
            self._pause_s = max(_PUBLISH_S, (time.monotonic() - now_s) / _PUBLISH_SHARE)
        if now_s - self._sent_s > _STATUS_S:
            self._timeline.closed(self._reconstructor.closures())
            self._send_status(status)

    def frames_skipped(self, skipped: int) -> None:
        """Publish the live result of a capture that is reconstructed again from its recording."""
        self._least_poses = 0
        status = self._reconstructor.status()
        if self._reconstructor.posed_frames:
            self._publish(status, every_frame=True)
        self._send_status(status)
        self._channel.send(FramesSkipped(frames=status.frames, skipped=skipped))

    def refine(self) -> None:
        """Mark the start of the refinement; its result is compared with the version before it."""
        self._refines = True
        self._hold()

    def _hold(self) -> None:
        self._publisher.protect_newest()
        self._candidates.add(self._publisher.version)

    def last(self, cut_short: bool) -> None:
        """Publish the final state, or an earlier version again if that is better."""
        self.tracked(None)
        self._timeline.closed(self._reconstructor.closures())
        self._least_poses = 0
        status = self._reconstructor.status()
        if self._reconstructor.posed_frames:
            self._publish(status, tolerance=0.0, every_frame=True)
        shown = self._best(cut_short)
        self._poses = self._poses if shown is None else shown.poses
        if shown is not None and shown.version != self._publisher.version:
            _log.info("version %d is better than the end of the refinement", shown.version)
            try:
                self._send_version(self._publisher.again(shown), shown.version)
            except OSError as error:
                raise _write_error(error) from error
        self._send_status(status, shown)

    def _best(self, cut_short: bool) -> Published | None:
        """The version to end with: the newest, unless an earlier one has a higher PSNR against the recording.

        After a restart by the user, versions of the previous run do not compete unless the run was cut short.
        """
        versions = self._publisher.versions
        ours = [one for one in versions if one.version >= (1 if cut_short or self._continues else self._own)]
        if not ours or not (self._poses or self._continues):
            return None
        newest = ours[-1]
        candidates = [
            one
            for one in ours[:-1]
            if (one.version in self._candidates or _estimated_better(one, newest))
            and pose_file(self._publisher.folder, one).exists()  # absent if written by an older release
        ]
        scene_psnr_db = {one.version: self._scene_psnr_db(one) for one in [newest, *candidates]} if candidates else {}
        return max([newest, *candidates], key=lambda one: scene_psnr_db.get(one.version, 0.0))

    def _scene_psnr_db(self, one: Published) -> float:
        scene = Scene.read_ply(self._publisher.folder / one.scene)
        poses = PoseFile(pose_file(self._publisher.folder, one))
        trajectory = poses.trajectory(range(len(poses)))
        optics = self._reconstructor.camera.intrinsics if one.intrinsics is None else Intrinsics(*one.intrinsics)
        return self._reconstructor.scene_psnr_db(scene, trajectory, optics)

    def _pose(self, view: Tracked, status: Status, latency_frames: int | None) -> PosePayload:
        assert view.rotation is not None and view.centre is not None
        rate = self._reconstructor.sensor.frame_rate_hz
        x, y, z = (float(value) for value in view.centre)
        qw, qx, qy, qz = (float(value) for value in quaternion(view.rotation[None])[0])
        return PosePayload(
            frame=int(view.time),
            time_s=view.time / rate,
            position=(x, y, z),
            quaternion_wxyz=(qw, qx, qy, qz),
            state=view.state,
            sigma_px=view.sigma_px,
            chi2=view.chi2,
            latency_s=None if latency_frames is None else latency_frames / rate,
        )

    def _publish(self, status: Status, tolerance: float = TOLERANCE, every_frame: bool = False) -> None:
        """Publish a version; while a long path is tracked with the poses of its views, or of `every_frame`."""
        poses = self._reconstructor.posed_frames
        self._published_s, self._seen = time.monotonic(), status.version
        if not poses or poses < self._least_poses:
            return
        try:
            trajectory = self._reconstructor.trajectory() if every_frame else self._reconstructor.trajectory_so_far()
            scene, white = self._reconstructor.scene(), self._reconstructor.white
            optics = self._reconstructor.camera.intrinsics
            rate_hz = self._reconstructor.sensor.frame_rate_hz
            states = self._timeline.states_at(frames_at(trajectory.times_s, rate_hz))
            psnr_db = _psnr_db(status.loss)
            published = self._publisher.publish(scene, trajectory, white, psnr_db, optics, states, tolerance, poses)
        except OSError as error:
            raise _write_error(error) from error
        self._send_version(published)

    def _send_version(self, published: Published, again_of: int | None = None) -> None:
        self._poses = published.poses
        self._channel.send(VersionPublished(published=published, kept=self._publisher.kept, again_of=again_of))

    def _send_status(self, status: Status, shown: Published | None = None) -> None:
        """Send the status; `shown` is the final version."""
        psnr_db = _psnr_db(status.loss) if shown is None else shown.psnr_db
        self._sent_s = time.monotonic()
        self._channel.send(
            ReconstructionStatus(
                state=status.state,
                reason=status.reason,
                stage=Stage(status.stage),
                frames=status.frames,
                splats=status.splats if shown is None else shown.splats,
                loss=status.loss if shown is None or psnr_db is None else 10 ** (-psnr_db / 10),
                progress=status.progress,
                poses=self._poses,
                version=self._publisher.version,
                psnr_db=psnr_db,
                eta_s=self._eta_s(status),
            )
        )

    def _eta_s(self, status: Status) -> float | None:
        """Seconds to the end of the current stage; None if unknown."""
        now_s = time.monotonic()
        if status.stage == Stage.REFINING:
            self._refining_s = self._refining_s or now_s
            done, since_s = status.progress, self._refining_s
        elif self._expected:
            done, since_s = status.frames / self._expected, self._begun_s
        else:
            return None
        return (now_s - since_s) * (1 - done) / done if done > 0.02 else None


def _estimated_better(one: Published, other: Published) -> bool:
    """Whether the PSNR estimated from the loss is higher; some views enter it at reduced size."""
    return one.psnr_db is not None and other.psnr_db is not None and one.psnr_db > other.psnr_db


def _write_error(error: OSError) -> SceneError:
    return SceneError(f"the scene cannot be published: {error.strerror}; free disk space")


def _psnr_db(loss: float | None) -> float | None:
    """PSNR of the mapped views, estimated from the loss, noise included."""
    return None if loss is None or loss <= 0 else float(-10 * np.log10(loss))
