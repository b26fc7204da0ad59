"""Publishes the progress of a reconstruction: events for the service, versions and timeline in a folder."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from spiked.errors import SceneError
from spiked.pose import quaternion
from spiked.poses import PoseFile
from spiked.recon import Merged, Reconstructor, State, Status, Tracked
from spiked.recon.background import Background
from spiked.scene import Scene
from spiked.trajectory import Trajectory
from spiked_service.base.malloc import return_freed
from spiked_service.events.payloads import PosePayload
from spiked_service.results.map_reports import REGISTRATION, REPORT, write_report
from spiked_service.results.published import Published
from spiked_service.results.shown_scene import TOLERANCE
from spiked_service.results.timeline import frames_at
from spiked_service.results.timeline_writer import TimelineWriter
from spiked_service.results.versions import Publisher, RecordedPath, pose_file
from spiked_service.store.rows import Stage
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import (
    FramesSkipped,
    PlaceCompared,
    PoseEstimated,
    ReconstructionCommand,
    ReconstructionStatus,
    VersionPublished,
)

_log = logging.getLogger("spiked.reconstruction")
_PUBLISH_S = 1.5
"""Least time between two published versions, seconds."""
_PUBLISH_SHARE = 0.1
"""Largest share of the time spent on publishing: trajectories of minutes take seconds to write."""
_STATUS_S = 0.2
"""Interval of status events, seconds."""
_PROGRESS_S = 1.0
"""Interval of the progress of the map in the timeline, seconds of work."""


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
        if not resumed:
            (command.folder / REPORT).unlink(missing_ok=True)
        views = len(reconstructor.views)
        self._timeline = TimelineWriter(command.folder, views, reconstructor.frames, reconstructor.work_s)
        self._channel = channel
        self._sent_s = self._published_s = self._noted_s = -np.inf
        self._seen = 0
        self._tracked = self._timeline.moments
        versions = self._publisher.versions if resumed else []
        self._poses = versions[-1].poses if versions else 0
        self._pause_s = _PUBLISH_S
        self._behind = command.ring is not None and not command.can_block
        """Versions are written on another thread: a live tracker does not wait for the disk."""
        self._publishing: Background[Published] | None = None
        self._version = self._publisher.version
        self._least_poses = command.least_poses
        self._continues = resumed or command.least_poses > 0
        """Versions of earlier workers belong to this run of the reconstruction."""
        self._own = self._publisher.version + 1
        """First version of this worker."""
        self._candidates: set[int] = set()
        """Versions that the last one is compared with, see `_best`."""
        self._refines = False
        self._joining_s: float | None = None
        self._state = State.BOOT

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
            self._timeline.tracked(view, status, _psnr_db(status.loss), self._reconstructor.work_s)
            if view.rotation is not None and view.centre is not None:
                self._channel.try_send(PoseEstimated(pose=self._pose(view, status, latency_frames)))

    def progress(self, status: Status) -> None:
        self.tracked(None)  # views that the end of the tracking has added
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
        self._take_published()
        due = status.version != self._seen and now_s - self._published_s > self._pause_s
        if due and self._publishing is None:
            self._publish(status, behind=self._behind)
        if now_s - self._sent_s > _STATUS_S:
            self._timeline.closed(self._reconstructor.closures())
            self._note_progress(status, _PROGRESS_S)
            self._send_status(status)

    def close(self) -> None:
        """Wait for the version that is being written, and tell of it. Raises SceneError if it cannot be."""
        self._take_published(wait=True)

    def _note_progress(self, status: Status, least_s: float = 0.0) -> None:
        work_s = self._reconstructor.work_s
        if work_s - self._noted_s > least_s:
            self._noted_s = work_s
            self._timeline.progress(status, _psnr_db(status.loss), work_s)

    def frames_skipped(self, skipped: int) -> None:
        """Publish the live result of a capture that is reconstructed again from its recording."""
        status = self._end()
        self._publish(status, every_frame=True)
        self._send_status(status)
        self._channel.send(FramesSkipped(frames=status.frames, skipped=skipped))

    def _end(self) -> Status:
        """The status after the last frame: timeline and next version have all of the path."""
        self.tracked(None)
        self._timeline.closed(self._reconstructor.closures())
        self._least_poses = 0
        return self._reconstructor.status()

    def refine(self) -> None:
        """Mark the start of the refinement; its result is compared with the version before it."""
        self._refines = True
        self._hold()

    def _hold(self) -> None:
        self._take_published(wait=True)
        self._publisher.protect_newest()
        self._candidates.add(self._publisher.version)

    def last(self, cut_short: bool) -> None:
        """Publish the final state, or an earlier version again if that is better."""
        status = self._end()
        self._note_progress(status)
        self._publish(status, tolerance=0.0, every_frame=True)
        shown = self._best(cut_short)
        self._poses = self._poses if shown is None else shown.poses
        if shown is not None and shown.version != self._publisher.version:
            _log.info("version %d is better than the end of the refinement", shown.version)
            try:
                self._send_version(self._publisher.again(shown), shown.version)
            except OSError as error:
                raise _write_error(error) from error
        self._write_report(REPORT, self._reconstructor.report())
        self._send_status(status, shown)

    def joining(self, share: float) -> None:
        """A map is joined with the reconstruction; `share` of that is done."""
        now_s = time.monotonic()
        if now_s - self._sent_s > _STATUS_S:
            self._joining_s = now_s if self._joining_s is None else self._joining_s
            self._send_status(replace(self._reconstructor.status(), stage=str(Stage.JOINING), progress=share))

    def not_joined(self, reason: str) -> None:
        """The map shows another place: the versions show the recording alone."""
        self._write_report(REGISTRATION, {"joined": False, "reason": reason})
        self._channel.send(PlaceCompared(recognised=False, reason=reason))
        self._send_status(self._reconstructor.status())

    def joined(self, made: Merged, others: Sequence[RecordedPath]) -> None:
        """Publish the map with the recording; `others` are the map's paths."""
        self._write_report(REGISTRATION, {"joined": True, "reason": "", **made.report()})
        self._channel.send(PlaceCompared(recognised=True, reason=""))
        white = made.scene.colour_of_white
        self._publish_scene(made.scene, made.joint.second.trajectory, white, None, tolerance=0.0, others=others)
        self._send_status(self._reconstructor.status(), self._publisher.versions[-1])

    def _write_report(self, name: str, figures: Mapping[str, object]) -> None:
        try:
            write_report(self._publisher.folder, name, figures)
        except OSError as error:
            raise _write_error(error) from error

    def _best(self, cut_short: bool) -> Published | None:
        """The version to end with: the newest, unless an earlier one has a higher PSNR against the recording.

        After a restart by the user, versions of the previous run do not compete unless the run was cut short.
        """
        # Those with paths of other recordings are in the frame of reference of a map.
        versions = [one for one in self._publisher.versions if not one.paths]
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
        optics = one.camera or self._reconstructor.camera.intrinsics
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

    def _publish(
        self, status: Status, tolerance: float = TOLERANCE, every_frame: bool = False, behind: bool = False
    ) -> None:
        """Publish a version if there is a path; while a long one is tracked with the poses of its views, or of
        `every_frame`. `behind`: on another thread."""
        poses = self._reconstructor.posed_frames
        self._published_s, self._seen = time.monotonic(), status.version
        if not poses or poses < self._least_poses:
            return
        trajectory = self._reconstructor.trajectory() if every_frame else self._reconstructor.trajectory_so_far()
        scene, white = self._reconstructor.scene(), self._reconstructor.white
        self._publish_scene(scene, trajectory, white, _psnr_db(status.loss), tolerance, poses, behind=behind)

    def _publish_scene(
        self,
        scene: Scene,
        trajectory: Trajectory,
        white: float,
        psnr_db: float | None,
        tolerance: float,
        poses: int | None = None,
        others: Sequence[RecordedPath] = (),
        behind: bool = False,
    ) -> None:
        self._take_published(wait=True)
        optics = self._reconstructor.camera.intrinsics
        rate_hz = self._reconstructor.sensor.frame_rate_hz
        states = self._timeline.states_at(frames_at(trajectory.times_s, rate_hz))

        def publish(_: Callable[[], bool]) -> Published:
            published = self._publisher.publish(
                scene, trajectory, white, psnr_db, optics, states, tolerance, poses, others
            )
            self._pause_s = max(_PUBLISH_S, (time.monotonic() - self._published_s) / _PUBLISH_SHARE)
            return_freed()
            return published

        self._publishing = Background(publish)
        self._take_published(wait=not behind)

    def _take_published(self, wait: bool = False) -> None:
        """Tell of the version that is being written once it is there, or `wait` for it."""
        if self._publishing is None or not (wait or self._publishing.done):
            return
        publishing, self._publishing = self._publishing, None
        try:
            self._send_version(publishing.result())
        except OSError as error:
            raise _write_error(error) from error

    def _send_version(self, published: Published, again_of: int | None = None) -> None:
        self._poses, self._version = published.poses, published.version
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
                version=self._version,
                psnr_db=psnr_db,
                eta_s=self._eta_s(status),
                warnings=tuple(self._reconstructor.warnings),
            )
        )

    def _eta_s(self, status: Status) -> float | None:
        """Seconds to the end of the refinement, or of the joining; None if unknown."""
        if status.stage != Stage.JOINING or self._joining_s is None:
            return status.left_s
        done = status.progress
        return (time.monotonic() - self._joining_s) * (1 - done) / done if done > 0.02 else None


def _estimated_better(one: Published, other: Published) -> bool:
    """Whether the PSNR estimated from the loss is higher; some views enter it at reduced size."""
    return one.psnr_db is not None and other.psnr_db is not None and one.psnr_db > other.psnr_db


def _write_error(error: OSError) -> SceneError:
    return SceneError(f"the scene cannot be published: {error.strerror}; free disk space")


def _psnr_db(loss: float | None) -> float | None:
    """PSNR of the mapped views, estimated from the loss, noise included."""
    return None if loss is None or loss <= 0 else float(-10 * np.log10(loss))
