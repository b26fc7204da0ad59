"""The reconstruction worker: frames from a ring into a `Reconstructor`, versions of its scene into a folder."""

import time
from dataclasses import replace

import numpy as np

from spiked.recon import Options, Reconstructor, Status
from spiked.ring import End, Frames, Gap, Policy, RingReader
from spiked_service.messages import ReconstructionOrder, ReconstructionStatus, Stage
from spiked_service.publication import Publisher
from spiked_service.worker import Link

_WAIT_S = 0.05
_SPARE_S = 0.1
"""Mapping at a time while no frames wait, short enough to come back before the ring is full."""
_UNHURRIED_FRAMES = 32
_UNHURRIED_S = 0.3
"""A source that waits is held up for this long after so many frames, so that the map keeps pace with the path."""
_PUBLISH_S = 1.5
_TELL_S = 0.2


def run_reconstruction(order: ReconstructionOrder, link: Link) -> None:
    """Feed, map in spare time, refine at the end; publish all the while. Raises ConfigurationError or RingError."""
    with RingReader.attach(order.ring, Policy.LOSSLESS, "reconstruction") as reader:
        sensor = reader.geometry.sensor
        if order.intrinsics is not None:
            sensor = replace(sensor, intrinsics=order.intrinsics)
        reconstructor = Reconstructor(sensor, Options(seed=order.seed, steps=order.steps))
        herald = _Herald(reconstructor, Publisher(order.folder), link)
        _follow(reader, reconstructor, herald, link, order.unhurried)
    reconstructor.finish(herald.progress, lambda: link.leave.is_set() or link.stop.is_set())
    herald.last()


def _follow(reader: RingReader, reconstructor: Reconstructor, herald: "_Herald", link: Link, unhurried: bool) -> None:
    """Take frames and gaps until the capture's end."""
    mapped_to = 0
    while not link.leave.is_set():
        item = reader.next(_WAIT_S)
        match item:
            case End():
                return
            case Gap():
                reconstructor.gap(item.first, item.count)
            case Frames():
                copied = np.array(item.data)
                if item.release():
                    reconstructor.feed(item.first, copied)
                if unhurried and item.first - mapped_to >= _UNHURRIED_FRAMES:
                    mapped_to = item.first
                    reconstructor.improve(_UNHURRIED_S)
            case None:
                reconstructor.improve(_SPARE_S)
        herald.progress(reconstructor.status())


class _Herald:
    """Tells the service how things stand and publishes versions, neither too often."""

    def __init__(self, reconstructor: Reconstructor, publisher: Publisher, link: Link) -> None:
        self._reconstructor = reconstructor
        self._publisher = publisher
        self._link = link
        self._told_s = self._published_s = -np.inf
        self._seen = 0
        self._poses = 0

    def progress(self, status: Status) -> None:
        now_s = time.monotonic()
        if status.version != self._seen and now_s - self._published_s > _PUBLISH_S:
            self._publish(status)
        if now_s - self._told_s > _TELL_S:
            self._tell(status)

    def last(self) -> None:
        """Publish and tell the final state."""
        status = self._reconstructor.status()
        if len(self._reconstructor.trajectory()):
            self._publish(status)
        self._tell(status)

    def _publish(self, status: Status) -> None:
        trajectory = self._reconstructor.trajectory()
        self._published_s, self._seen = time.monotonic(), status.version
        if len(trajectory):
            self._publisher.publish(self._reconstructor.scene(), trajectory, self._reconstructor.white)
            self._poses = len(trajectory)

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
            )
        )
