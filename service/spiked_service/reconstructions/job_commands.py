"""The command for the worker of a queued job."""

from pathlib import Path

from spiked_service.reconstructions.admission import intrinsics_of
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, ReconstructionRow, Task
from spiked_service.workers.messages import JobCommand, LocalisationCommand, MergeCommand, ReconstructionCommand


def command_of(row: ReconstructionRow, capture: CaptureRow, folder: DataFolder, least_poses: int) -> JobCommand:
    """What the worker is to do; `least_poses` as in `ReconstructionCommand`."""
    maps = folder.maps(row.id, len(row.maps))
    match row.task:
        case Task.MERGE:
            return MergeCommand(
                capture_id=capture.id,
                reconstruction_id=row.id,
                folder=folder.reconstruction(row.id),
                maps=(maps[0], maps[1]),
                seed=row.options.seed,
                threads=row.options.threads,
            )
        case Task.LOCALISE:
            return LocalisationCommand(
                capture_id=capture.id,
                reconstruction_id=row.id,
                recording=folder.recording(capture.id),
                folder=folder.reconstruction(row.id),
                map=maps[0],
                intrinsics=intrinsics_of(row.options, capture),
                part=row.part,
                threads=row.options.threads,
            )
        case _:
            return _reconstruction(row, capture, folder, least_poses, maps[0] if maps else None)


def _reconstruction(
    row: ReconstructionRow, capture: CaptureRow, folder: DataFolder, least_poses: int, known: Path | None
) -> ReconstructionCommand:
    return ReconstructionCommand(
        capture_id=capture.id,
        reconstruction_id=row.id,
        ring=None,
        recording=folder.recording(capture.id),
        folder=folder.reconstruction(row.id),
        can_block=True,
        options=row.options,
        intrinsics=intrinsics_of(row.options, capture),
        calibration=folder.given_calibration(row.id) if row.calibration_from else None,
        poses=folder.given_poses(row.id) if row.poses_from else None,
        least_poses=least_poses,
        map=known,
    )
