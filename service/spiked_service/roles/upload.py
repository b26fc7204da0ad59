"""The upload worker: looks at every byte of a recording from elsewhere, so that the service itself never does."""

import hashlib
from pathlib import Path

from spiked.errors import RecordingError
from spiked.recording import verify
from spiked.recording.sidecar import Sidecar, sidecar_path, write_sidecar
from spiked.sensor import Intrinsics
from spiked_service.messages import UploadChecked, UploadOrder
from spiked_service.worker import Link

_CHUNK_BYTES = 4 << 20
_LARGEST_SIDE = 16384


def run_upload(order: UploadOrder, link: Link) -> None:
    """Verify a recording, write its sidecar beside it, and tell what it is.

    Raises RecordingError or ConfigurationError for what cannot be a recording.
    """
    digest = _sha256(order.path)
    if order.sha256 is not None and digest != order.sha256:
        raise RecordingError(f"the file that came has the SHA-256 {digest}, not {order.sha256}; send it again")
    beside = sidecar_path(order.path)
    if order.sidecar is not None:
        # A calibration names a file of another machine; none is looked for here.
        write_sidecar(beside, order.sidecar.model_copy(update={"calibration": None}))
    said = order.geometry
    k = said.intrinsics
    found = verify(
        order.path,
        width=said.width,
        height=said.height,
        frame_rate_hz=said.frame_rate_hz,
        layout=said.layout,
        bit_order=said.bit_order,
        flipped=said.flipped,
        mosaic=said.mosaic,
        intrinsics=None if k is None else Intrinsics(k.fx, k.fy, k.cx, k.cy),
    )
    recording, sensor = found.recording, found.recording.sensor
    if max(sensor.width, sensor.height) > _LARGEST_SIDE:
        raise RecordingError(f"{sensor.width}x{sensor.height} pixels are more than {_LARGEST_SIDE} on a side")
    more = {} if order.sidecar is None else {"note": order.sidecar.note, "device": order.sidecar.device}
    write_sidecar(beside, Sidecar.of(sensor, recording.frames, gaps=recording.gaps, clock=recording.clock, **more))
    link.tell(
        UploadChecked(
            sensor=sensor,
            frames=recording.frames,
            bytes=order.path.stat().st_size,
            lost=sum(gap.count for gap in recording.gaps),
            sha256=digest,
            grade=found.verdict.value,
            reasons=found.reasons,
        )
    )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()
