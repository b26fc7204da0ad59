"""The commands for the workers of jobs."""

from datetime import UTC, datetime
from pathlib import Path

from spiked.recording.geometry import orientation_questions
from spiked_service.base.ids import new_id
from spiked_service.reconstructions.admission import intrinsics_of
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, JobState, ReconstructionRow, Task
from spiked_service.workers.messages import (
    JobCommand,
    LocalisationCommand,
    MergeCommand,
    ReconstructionCommand,
    RingOpened,
)


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


def live_row(capture: CaptureRow) -> ReconstructionRow:
    """The row of a live reconstruction that begins now."""
    now = datetime.now(UTC)
    return ReconstructionRow(
        new_id(), capture.id, True, JobState.RUNNING, now, options=capture.plan.options, attempts=1, started_at=now
    )


def live_command(
    row: ReconstructionRow,
    capture: CaptureRow,
    opened: RingOpened,
    folder: DataFolder,
    first_frame: int,
    stop_frame: int | None,
) -> ReconstructionCommand:
    """What the worker of a live reconstruction is to do: the frames of the ring from `first_frame` to `stop_frame`."""
    return ReconstructionCommand(
        capture_id=capture.id,
        reconstruction_id=row.id,
        ring=opened.name,
        recording=None,
        folder=folder.reconstruction(row.id),
        can_block=opened.can_block,
        options=row.options,
        intrinsics=intrinsics_of(row.options, capture),
        calibration=opened.calibration,
        questions=orientation_questions(opened.assumed, opened.sensor),
        first_frame=first_frame,
        stop_frame=stop_frame,
        recorded=capture.plan.record,
    )


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
