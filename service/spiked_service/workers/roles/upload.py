"""The upload worker: verifies and converts uploads, so that the service never parses uploaded data."""

import hashlib
import os
import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

from spiked.calibration import Calibration
from spiked.camera import MOST_SIDE, StoredCameraOptions
from spiked.errors import ConfigurationError, RecordingError
from spiked.recon.frontend.mosaic_check import recorded_layout_warnings
from spiked.recording import RecordingGeometry, verify
from spiked.recording.sidecar import Sidecar, lost_by_cause, sidecar_path, write_sidecar
from spiked.sensor import Layout
from spiked_service.conversion.form import RECORDINGS, Form
from spiked_service.conversion.reading import detect_form, read_content
from spiked_service.conversion.writing import write_content
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import UploadChecked, UploadCommand, UploadConverts
from spiked_service.workers.roles.recorder import CALIBRATION

_MOST_MEMORY_BYTES = 4 << 30
"""Memory of the worker: a file that unpacks to more ends with an error. Mapped files do not count."""


def run_upload(command: UploadCommand, channel: WorkerChannel) -> None:
    """Make a recording of an upload, verify it, write its sidecar and send the result.

    Raises RecordingError or ConfigurationError if it holds none.
    """
    _limit_memory()
    digest = _sha256(command.path)
    if command.sha256 is not None and digest != command.sha256:
        raise RecordingError(f"the received file has the SHA-256 {digest}, not {command.sha256}; send it again")
    command.converted.unlink(missing_ok=True)  # of a service that was killed
    sidecar_path(command.path).unlink(missing_ok=True)
    form = command.form or _detected(command)
    if form is None or form in RECORDINGS:
        checked = _checked(command, command.path, _with_layout(command.camera, form), digest)
    else:
        warnings = _convert(command, form, channel)
        camera = command.camera.model_copy(update=dict.fromkeys(("width", "height", "layout", "bit_order")))
        checked = _checked(command, command.converted, camera, _sha256(command.converted))
        checked = checked.model_copy(update={"converted": True, "warnings": (*warnings, *checked.warnings)})
    channel.send(checked)


def _detected(command: UploadCommand) -> Form | None:
    """The form of a file that is no recording, as far as its first bytes show it."""
    if command.sidecar is not None or command.camera.layout is not None:
        return None
    return detect_form(command.path)


def _with_layout(camera: StoredCameraOptions, form: Form | None) -> StoredCameraOptions:
    """The camera with the layout of a recording of that form. Raises ConfigurationError."""
    if form is None:
        return camera
    layout = Layout(form.value)
    if camera.layout not in (None, layout):
        raise ConfigurationError(f"the form {form} contradicts the layout {camera.layout}: give one of them")
    return camera.model_copy(update={"layout": layout})


def _convert(command: UploadCommand, form: Form, channel: WorkerChannel) -> list[str]:
    """Write `command.converted`; returns warnings. Raises RecordingError or ConfigurationError, and leaves nothing."""
    if command.sidecar is not None:
        raise ConfigurationError(f"a sidecar is of a recording, not of {form}: state the camera as geometry")
    warnings: list[str] = []
    given = RecordingGeometry.of(command.camera)
    content = read_content(command.path, form, given, warnings.append, command.array)
    if content.most_bytes > command.limit_bytes:
        raise RecordingError(
            f"its {content.most_frames} frames of {content.sensor.width}x{content.sensor.height} are a recording of "
            f"{content.most_bytes} bytes, more than the limit of {command.limit_bytes} for an upload"
        )
    channel.send(UploadConverts(bytes=content.most_bytes))
    write_content(content, command.converted, Form.COMPACT, warnings.append)
    with command.converted.open("rb") as file:
        os.fsync(file.fileno())
    return warnings


def _checked(command: UploadCommand, path: Path, camera: StoredCameraOptions, digest: str) -> UploadChecked:
    """Verify a recording and write its sidecar."""
    beside = sidecar_path(path)
    if command.sidecar is not None:
        # A calibration refers to a file of the machine that sent it.
        write_sidecar(beside, command.sidecar.model_copy(update={"calibration": None}))
    found = verify(path, **RecordingGeometry.of(camera).stated())
    recording, sensor = found.recording, camera.sensor(found.recording.sensor)
    if max(sensor.width, sensor.height) > MOST_SIDE:
        raise RecordingError(f"{sensor.width}x{sensor.height} pixels are more than {MOST_SIDE} on a side")
    more: dict[str, Any] = {"assumed": recording.assumed}
    if command.calibration is not None:
        Calibration.read(command.calibration).check(sensor)
        more["calibration"] = CALIBRATION
    if command.sidecar is not None:
        more |= {"note": command.sidecar.note, "device": command.sidecar.device}
    write_sidecar(beside, Sidecar.of(sensor, recording.frames, gaps=recording.gaps, clock=recording.clock, **more))
    return UploadChecked(
        converted=False,
        sensor=sensor,
        frames=recording.frames,
        bytes=path.stat().st_size,
        lost=lost_by_cause(recording.gaps),
        sha256=digest,
        grade=found.verdict.value,
        reasons=found.reasons,
        warnings=(*recording.questions, *recorded_layout_warnings(replace(recording, sensor=sensor))),
    )


def _limit_memory() -> None:
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = _MOST_MEMORY_BYTES if most == resource.RLIM_INFINITY else min(most, _MOST_MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, most))


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
