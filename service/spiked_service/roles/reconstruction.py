"""The reconstruction worker: frames from a ring or a recording into a `Reconstructor`, its scene into a folder."""

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.pose import quaternion
from spiked.recon import Reconstructor, State, Status, Tracked
from spiked.recon.views import MARGIN
from spiked.recording import open_recording
from spiked.ring import End, Frames, Gap, Policy, RingReader
from spiked.sensor import Intrinsics, Sensor
from spiked_service.chronicle import Chronicle
from spiked_service.messages import (
    Outpaced,
    Posed,
    ReconstructionOrder,
    ReconstructionStatus,
    Stage,
    VersionPublished,
)
from spiked_service.offline import pieces
from spiked_service.payloads import PosePayload
from spiked_service.publication import Publisher
from spiked_service.pursuit import LATE_FRAMES, Glances, next_glance
from spiked_service.worker import Link

_log = logging.getLogger("spiked.reconstruction")
_WAIT_S = 0.05
_SPARE_S = 0.1
"""Mapping at a time while no frames wait, short enough to come back before the ring is full."""
_UNHURRIED_FRAMES = 32
_UNHURRIED_S = 0.3
"""A source that waits is held up for this long after so many frames, so that the map keeps pace with the path."""
_PUBLISH_S = 1.5
_PUBLISH_SHARE = 0.1
"""A path of minutes takes seconds to write: versions come less often, rather than take more of the time than this."""
_TELL_S = 0.2
_PUNCTUAL_S = 0.04
"""As long as it is no later than this, the map gets its share after every glance, ..."""
_MOST_UNMAPPED = 4
"""... and otherwise after so many."""
_GLIMPSE_S = 0.01
"""A step or two of mapping between two glances at a camera that is faster than the tracker."""
_LIVE_NICE = 5
"""Mapping takes every core there is; acquisition, and views of what is mapped, go before it."""
_OFFLINE_NICE = 10


def run_reconstruction(order: ReconstructionOrder, link: Link) -> None:
    """Feed, map in spare time, refine at the end; publish all the while.

    Raises ConfigurationError, RecordingError or RingError for what is the user's to mend, SceneError when the disk does
    not take what is to be published.
    """
    if order.ring is not None:
        os.nice(_LIVE_NICE)
        # A source that waits never runs ahead; after any other the tracker catches up from as far back as it can.
        policy = Policy.LOSSLESS if order.unhurried else Policy.PRIORITY
        with RingReader.attach(order.ring, policy, "reconstruction", order.first_frame) as reader:
            work = _begin(order, reader.geometry.sensor, link)
            passed = _follow(reader, work, order)
            if passed and order.recorded:
                work.herald.outpaced(passed)
                return
            if passed and work.reconstructor.status().state is State.BOOT and not link.stop.is_set():
                work = _once_more(reader, work, order)
    else:
        assert order.recording is not None, "an order names a ring or a recording"
        os.nice(_OFFLINE_NICE)  # a live capture comes first
        recording = open_recording(order.recording)
        work = _begin(order, recording.sensor, link)
        work.herald.expect(recording.capture_index(recording.frames - 1) + 1)
        _read(order, work)
    work.reconstructor.finish(work.herald.progress, lambda: link.leave.is_set() or link.stop.is_set())
    if not link.leave.is_set():
        work.herald.last()


@dataclass(frozen=True)
class _Work:
    reconstructor: Reconstructor
    herald: "_Herald"
    link: Link

    def feed(self, first: int, frames: NDArray[np.uint8], newest: Callable[[], int] | None = None) -> None:
        """`newest` tells how many frames there are by now; None: they do not come from a camera."""
        self.reconstructor.feed(first, frames)
        self.herald.tracked(newest and newest() - first - len(frames))

    def glance(self, first: int, frames: NDArray[np.uint8], newest: Callable[[], int]) -> None:
        self.reconstructor.glance(first, frames)
        self.herald.tracked(newest() - first - len(frames))

    def lose(self, first: int, count: int, cause: str) -> None:
        self.reconstructor.gap(first, count)
        self.herald.lost(first, count, cause)


def _begin(order: ReconstructionOrder, sensor: Sensor, link: Link) -> _Work:
    intrinsics: Intrinsics | None = order.intrinsics or sensor.intrinsics
    reconstructor = Reconstructor(replace(sensor, intrinsics=intrinsics), order.options.options())
    return _Work(reconstructor, _Herald(reconstructor, order, link), link)


def _follow(reader: RingReader, work: _Work, order: ReconstructionOrder, may_pass: bool = True) -> int:
    """Take frames and gaps until the capture's end; how many of them were passed over, because there were too many."""
    mapped_to = 0
    zero, stop = order.first_frame, order.stop_frame

    def newest() -> int:
        return _within(0, reader.newest_frame, 0, stop)[1] - zero

    while not work.link.leave.is_set():
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
                    work.feed(begin - zero, part, None if order.unhurried else newest)
                if order.unhurried and item.first - mapped_to >= _UNHURRIED_FRAMES:
                    mapped_to = item.first
                    work.reconstructor.improve(_UNHURRIED_S)
                elif may_pass and not order.unhurried and newest() + zero - end > LATE_FRAMES:
                    return _pursue(Glances(reader, end), work, order, newest)
            case None:
                work.reconstructor.improve(_SPARE_S)
        if stop is not None and isinstance(item, Gap | Frames) and item.first + item.count >= stop:
            return 0
        work.herald.progress(work.reconstructor.status())
    return 0


def _pursue(glances: Glances, work: _Work, order: ReconstructionOrder, newest: Callable[[], int]) -> int:
    """Look at the newest frames until the capture's end; how many were passed over."""
    zero, stop = order.first_frame, order.stop_frame
    reconstructor = work.reconstructor
    rate_hz = reconstructor.sensor.frame_rate_hz
    unmapped = 0
    while not work.link.leave.is_set() and (stop is None or glances.at < stop):
        count = reconstructor.glance_frames
        first = next_glance(glances.at, newest() + zero, count, reconstructor.speed_px, rate_hz)
        glances.look_at(first, count)
        while (item := glances.take(_WAIT_S)) is None and not work.link.leave.is_set():
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
                if end - begin > MARGIN:
                    work.glance(begin - zero, frames[: end - begin], newest)
                unmapped += 1
                if newest() + zero - end < _PUNCTUAL_S * rate_hz or unmapped >= _MOST_UNMAPPED:
                    unmapped = 0
                    reconstructor.improve(_GLIMPSE_S)
        work.herald.progress(reconstructor.status())
    return glances.passed


def _once_more(reader: RingReader, work: _Work, order: ReconstructionOrder) -> _Work:
    """The end of a capture that nobody recorded and that no path was found in at a glance: all that the ring holds."""
    with reader.another(Policy.PRIORITY, "reconstruction again", order.first_frame) as behind:
        again = _begin(order, reader.geometry.sensor, work.link)
        _follow(behind, again, order, may_pass=False)
    return again


def _within(first: int, last: int, begin: int, stop: int | None) -> tuple[int, int]:
    return max(first, begin), last if stop is None else min(last, stop)


def _read(order: ReconstructionOrder, work: _Work) -> None:
    """Feed a whole recording with its gaps."""
    assert order.recording is not None
    recording = open_recording(order.recording)
    causes = {gap.first: gap.cause for gap in recording.gaps}
    expected = 0
    for piece in pieces(recording):
        if work.link.stop.is_set():
            return
        if piece.index > expected:
            work.lose(expected, piece.index - expected, causes.get(expected, "unknown"))
        # Stored frames may have row numbers, which the reconstructor knows from the sensor.
        work.feed(piece.index, np.array(recording.read(piece.first, piece.count)))
        expected = piece.index + piece.count
        work.herald.progress(work.reconstructor.status())


class _Herald:
    """Tells the service how things stand and publishes versions, neither too often; keeps the timeline."""

    def __init__(self, reconstructor: Reconstructor, order: ReconstructionOrder, link: Link) -> None:
        self._reconstructor = reconstructor
        self._publisher = Publisher(order.folder)
        self._chronicle = Chronicle(order.folder)
        self._link = link
        self._told_s = self._published_s = -np.inf
        self._seen = 0
        self._tracked = 0
        self._poses = 0
        self._pause_s = _PUBLISH_S
        self._least_poses = order.least_poses
        self._begun_s = time.monotonic()
        self._refining_s: float | None = None
        self._expected: int | None = None
        self._state = State.BOOT

    def expect(self, frames: int) -> None:
        """So many frames will come."""
        self._expected = frames

    def lost(self, first: int, count: int, cause: str) -> None:
        self._chronicle.lost(first, count, cause)

    def tracked(self, latency_frames: int | None) -> None:
        """Tell of the views that were tracked since the last call."""
        new = self._reconstructor.tracked(self._tracked)
        self._tracked += len(new)
        if not new:
            return
        status = self._reconstructor.status()
        for view in new:
            self._chronicle.tracked(view, status, _psnr_db(status.loss))
            if view.rotation is not None and view.centre is not None:
                self._link.mention(Posed(pose=self._pose(view, status, latency_frames)))

    def progress(self, status: Status) -> None:
        now_s = time.monotonic()
        if status.state is not self._state:
            _log.info(
                "%s after %d frames%s", status.state, status.frames, f": {status.reason}" if status.reason else ""
            )
            self._state = status.state
        if status.version != self._seen and now_s - self._published_s > self._pause_s:
            self._publish(status)
            self._pause_s = max(_PUBLISH_S, (time.monotonic() - now_s) / _PUBLISH_SHARE)
        if now_s - self._told_s > _TELL_S:
            self._tell(status)

    def outpaced(self, passed: int) -> None:
        """Publish what was found live, of a capture that is to be gone through once more."""
        self._least_poses = 0
        status = self._reconstructor.status()
        if len(self._reconstructor.trajectory()):
            self._publish(status)
        self._tell(status)
        self._link.tell(Outpaced(frames=status.frames, passed=passed))

    def last(self) -> None:
        """Publish and tell the final state."""
        self.tracked(None)
        self._least_poses = 0
        status = self._reconstructor.status()
        if len(self._reconstructor.trajectory()):
            self._publish(status)
        self._tell(status)

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

    def _publish(self, status: Status) -> None:
        trajectory = self._reconstructor.trajectory()
        self._published_s, self._seen = time.monotonic(), status.version
        if not len(trajectory) or len(trajectory) < self._least_poses:
            return
        try:
            scene, white = self._reconstructor.scene(), self._reconstructor.white
            optics = self._reconstructor.camera.intrinsics
            published = self._publisher.publish(scene, trajectory, white, _psnr_db(status.loss), optics)
        except OSError as error:
            raise SceneError(f"the scene cannot be published: {error.strerror}; make room on the disk") from error
        self._poses = len(trajectory)
        self._link.tell(
            VersionPublished(
                version=published.version,
                splats=published.splats,
                poses=published.poses,
                white=published.white,
                scene_bytes=published.scene_bytes,
                psnr_db=published.psnr_db,
                kept=self._publisher.kept,
            )
        )

    def _tell(self, status: Status) -> None:
        self._told_s = time.monotonic()
        self._link.tell(
            ReconstructionStatus(
                state=status.state,
                reason=status.reason,
                stage=Stage(status.stage),
                frames=status.frames,
                splats=status.splats,
                loss=status.loss,
                progress=status.progress,
                poses=self._poses,
                version=self._publisher.version,
                psnr_db=_psnr_db(status.loss),
                eta_s=self._eta_s(status),
            )
        )

    def _eta_s(self, status: Status) -> float | None:
        """Time to the end of the refinement, once it runs; of tracking, where the number of frames is known."""
        now_s = time.monotonic()
        if status.stage == Stage.REFINING:
            self._refining_s = self._refining_s or now_s
            done, since_s = status.progress, self._refining_s
        elif self._expected:
            done, since_s = status.frames / self._expected, self._begun_s
        else:
            return None
        return (now_s - since_s) * (1 - done) / done if done > 0.02 else None


def _psnr_db(loss: float | None) -> float | None:
    """An estimate from the loss: the likeness of the views that are mapped, noise included."""
    return None if loss is None or loss <= 0 else float(-10 * np.log10(loss))
