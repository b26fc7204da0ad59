"""The reconstruction worker: frames from a ring or a recording into a `Reconstructor`, its scene into a folder."""

import logging
import os
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.pose import quaternion
from spiked.recon import Reconstructor, State, Status, Tracked
from spiked.recording import open_recording
from spiked.ring import End, Frames, Gap, Policy, RingReader
from spiked.sensor import Intrinsics, Sensor
from spiked_service.chronicle import Chronicle
from spiked_service.messages import Posed, ReconstructionOrder, ReconstructionStatus, Stage, VersionPublished
from spiked_service.offline import pieces
from spiked_service.payloads import PosePayload
from spiked_service.publication import Publisher
from spiked_service.worker import Link

_log = logging.getLogger("spiked.reconstruction")
_WAIT_S = 0.05
_SPARE_S = 0.1
"""Mapping at a time while no frames wait, short enough to come back before the ring is full."""
_UNHURRIED_FRAMES = 32
_UNHURRIED_S = 0.3
"""A source that waits is held up for this long after so many frames, so that the map keeps pace with the path."""
_PUBLISH_S = 1.5
_TELL_S = 0.2
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
        with RingReader.attach(order.ring, Policy.LOSSLESS, "reconstruction", order.first_frame) as reader:
            work = _begin(order, reader.geometry.sensor, link)
            _follow(reader, work, order)
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

    def feed(self, first: int, frames: NDArray[np.uint8], latency_frames: int | None = None) -> None:
        self.reconstructor.feed(first, frames)
        self.herald.tracked(latency_frames)

    def lose(self, first: int, count: int, cause: str) -> None:
        self.reconstructor.gap(first, count)
        self.herald.lost(first, count, cause)


def _begin(order: ReconstructionOrder, sensor: Sensor, link: Link) -> _Work:
    intrinsics: Intrinsics | None = order.intrinsics or sensor.intrinsics
    reconstructor = Reconstructor(replace(sensor, intrinsics=intrinsics), order.options.options())
    return _Work(reconstructor, _Herald(reconstructor, order, link), link)


def _follow(reader: RingReader, work: _Work, order: ReconstructionOrder) -> None:
    """Take frames and gaps until the capture's end."""
    mapped_to = 0
    zero, stop = order.first_frame, order.stop_frame
    while not work.link.leave.is_set():
        item = reader.next(_WAIT_S)
        match item:
            case End():
                return
            case Gap():
                begin, end = _within(item.first, item.first + item.count, zero, stop)
                if end > begin:
                    work.lose(begin - zero, end - begin, item.cause)
            case Frames():
                copied = np.array(item.data)
                begin, end = _within(item.first, item.first + item.count, zero, stop)
                if item.release() and end > begin:
                    late = None if order.unhurried else reader.status().writer.next_frame - end
                    work.feed(begin - zero, copied[begin - item.first : end - item.first], late)
                if order.unhurried and item.first - mapped_to >= _UNHURRIED_FRAMES:
                    mapped_to = item.first
                    work.reconstructor.improve(_UNHURRIED_S)
            case None:
                work.reconstructor.improve(_SPARE_S)
        if stop is not None and isinstance(item, Gap | Frames) and item.first + item.count >= stop:
            return
        work.herald.progress(work.reconstructor.status())


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
        if status.version != self._seen and now_s - self._published_s > _PUBLISH_S:
            self._publish(status)
        if now_s - self._told_s > _TELL_S:
            self._tell(status)

    def last(self) -> None:
        """Publish and tell the final state."""
        self.tracked(None)
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
        if not len(trajectory):
            return
        try:
            scene, white = self._reconstructor.scene(), self._reconstructor.white
            published = self._publisher.publish(scene, trajectory, white, _psnr_db(status.loss))
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
