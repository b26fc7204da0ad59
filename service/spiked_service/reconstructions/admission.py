"""Whether a job can be carried out, as far as that is known before it begins."""

from dataclasses import replace

from spiked.errors import ConfigurationError
from spiked.sensor import Intrinsics
from spiked_service.base.errors import BusyError
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.map_folder import camera_in
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import CaptureRow, ReconstructionRow, Task


def check(row: ReconstructionRow, catalogue: Catalogue, rows: ReconstructionRepository) -> None:
    """Raises UnknownIdError, BusyError and ConfigurationError for a job that cannot be carried out."""
    capture = catalogue.captures.get(row.capture_id)
    if row.task.reads_recording:
        _check_recording(capture)
    for used in row.maps:
        _check_map(rows.get(used.reconstruction_id), catalogue)
    if len({used.reconstruction_id for used in row.maps}) < len(row.maps):
        raise ConfigurationError("a reconstruction cannot be merged with itself: name another one")
    if row.task is Task.LOCALISE and capture.sensor is not None:
        sensor = replace(capture.sensor, intrinsics=intrinsics_of(row.options, capture))
        camera_in(sensor, rows.map_camera(row.maps[0].reconstruction_id))


def intrinsics_of(options: ReconstructionOptions, capture: CaptureRow) -> Intrinsics | None:
    """The lens of a recording, as far as it is stated."""
    if options.intrinsics is not None:
        return options.intrinsics.intrinsics()
    return capture.plan.intrinsics or (None if capture.sensor is None else capture.sensor.intrinsics)


def _check_map(row: ReconstructionRow, catalogue: Catalogue) -> None:
    _check_not_deleted(catalogue.captures.get(row.capture_id))
    if not row.state.over:
        raise BusyError(f"reconstruction {row.id} is {row.state}: wait for its end, then use it as a map")
    if row.task is Task.LOCALISE:
        its_map = row.maps[0].reconstruction_id
        raise ConfigurationError(f"{row.id} is a localisation and no map: use its map {its_map}")


def _check_not_deleted(capture: CaptureRow) -> None:
    if capture.deleted_at is not None:
        raise ConfigurationError(f"capture {capture.id} is deleted: restore it first")


def _check_recording(capture: CaptureRow) -> None:
    _check_not_deleted(capture)
    if not capture.plan.record or (capture.state.over and (capture.recording is None or not capture.recording.frames)):
        raise ConfigurationError(f"capture {capture.id} has no recording to reconstruct from")
