"""Publishes service events on the bus."""

import base64
import logging

from spiked_service.api.schemas import CaptureOut, ReconstructionOut
from spiked_service.events.bus import Bus, Topic
from spiked_service.events.logging import logger
from spiked_service.events.payloads import PosePayload, PreviewPayload, ScenePayload
from spiked_service.results.published import Published
from spiked_service.store.rows import ReconstructionRow
from spiked_service.store.snapshot import Snapshot
from spiked_service.workers.messages import PreviewKind, PreviewTaken

_LOG = logger("spiked.service")
_SHOWN = (PreviewKind.INTERVAL, PreviewKind.RATE)


class BusNotifier:
    """Implements `reconstructions.notifier.Notifier`."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def capture(self, snapshot: Snapshot) -> None:
        """A capture has changed, or its counters have."""
        self._bus.publish(Topic.CAPTURE, CaptureOut.of(snapshot), capture_id=snapshot.id)

    def job(self, row: ReconstructionRow) -> None:
        """A reconstruction has changed."""
        self._bus.publish(Topic.JOB, ReconstructionOut.of(row), row.capture_id, row.id)

    def pose(self, row: ReconstructionRow, pose: PosePayload) -> None:
        """A pose was estimated."""
        self._bus.publish(Topic.POSE, pose, row.capture_id, row.id)

    def scene(self, row: ReconstructionRow, published: Published) -> None:
        """A version was published."""
        payload = ScenePayload(
            version=published.version,
            splats=published.splats,
            psnr_db=published.psnr_db,
            bytes=published.scene_bytes,
        )
        self._bus.publish(Topic.SCENE, payload, row.capture_id, row.id)

    def preview(self, capture_id: str | None, taken: PreviewTaken) -> None:
        """There are newer preview images."""
        for kind in _SHOWN:
            payload = PreviewPayload(
                frame=taken.frame,
                kind="interval" if kind is PreviewKind.INTERVAL else "rate",
                width=taken.width,
                height=taken.height,
                image=base64.b64decode(taken.images[kind]),
                rate_histogram=taken.rate_histogram,
            )
            self._bus.publish(Topic.PREVIEW, payload, capture_id)

    def log(self, level: str, event: str, capture_id: str | None = None, reconstruction_id: str | None = None) -> None:
        """Write a line to the log, which is also published on the bus."""
        ids = {"capture_id": capture_id, "reconstruction_id": reconstruction_id}
        known = {name: value for name, value in ids.items() if value is not None}
        _LOG.log(logging.getLevelNamesMapping()[level.upper()], event, **known)
