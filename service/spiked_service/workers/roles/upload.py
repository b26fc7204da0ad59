"""The upload worker: verifies uploaded recordings, so that the service never parses uploaded data."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from spiked.errors import RecordingError
from spiked.recon.frontend.mosaic_check import recorded_layout_warnings
from spiked.recording import RecordingGeometry, verify
from spiked.recording.sidecar import Sidecar, lost_by_cause, sidecar_path, write_sidecar
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import UploadChecked, UploadCommand

_CHUNK_BYTES = 4 << 20
"""Bytes hashed at a time."""
_LARGEST_SIDE = 16384
"""Pixels of a side, at most."""


def run_upload(command: UploadCommand, channel: WorkerChannel) -> None:
    """Verify a recording, write its sidecar and send the result.

    Raises RecordingError or ConfigurationError if it is not a recording.
    """
    digest = _sha256(command.path)
    if command.sha256 is not None and digest != command.sha256:
        raise RecordingError(f"the received file has the SHA-256 {digest}, not {command.sha256}; send it again")
    beside = sidecar_path(command.path)
    if command.sidecar is not None:
        # A calibration refers to a file of the machine that sent it.
        write_sidecar(beside, command.sidecar.model_copy(update={"calibration": None}))
    found = verify(command.path, **RecordingGeometry.of(command.camera).stated())
    recording, sensor = found.recording, command.camera.sensor(found.recording.sensor)
    if max(sensor.width, sensor.height) > _LARGEST_SIDE:
        raise RecordingError(f"{sensor.width}x{sensor.height} pixels are more than {_LARGEST_SIDE} on a side")
    more: dict[str, Any] = {"assumed": recording.assumed}
    if command.sidecar is not None:
        more |= {"note": command.sidecar.note, "device": command.sidecar.device}
    write_sidecar(beside, Sidecar.of(sensor, recording.frames, gaps=recording.gaps, clock=recording.clock, **more))
    channel.send(
        UploadChecked(
            sensor=sensor,
            frames=recording.frames,
            bytes=command.path.stat().st_size,
            lost=lost_by_cause(recording.gaps),
            sha256=digest,
            grade=found.verdict.value,
            reasons=found.reasons,
            warnings=(*recording.questions, *recorded_layout_warnings(replace(recording, sensor=sensor))),
        )
    )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()
