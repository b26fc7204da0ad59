"""Poses and calibration that a job is given: copied into its folder, so that nothing else changes or removes them."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from spiked.calibration import Calibration
from spiked.errors import ConfigurationError, SceneError
from spiked.poses import PoseFile
from spiked.recon.given_poses import LEAST_POSES, GivenPoses
from spiked.trajectory import Trajectory
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.versions import newest, pose_file
from spiked_service.store.catalogue import StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, ReconstructionRow

FROM_FILE = "file"
"""`ReconstructionRow.poses_from` of poses that came with the request."""


@dataclass(frozen=True)
class Given:
    """What is not estimated and not taken from the recording."""

    poses: str | None = None
    """Text of a TUM file, seconds since the start of the capture."""
    poses_of: str | None = None
    """Another reconstruction of the same capture, whose newest path is taken."""
    calibration_of: str = ""
    """A device, ..."""
    calibration: Path | None = None
    """... and its calibration."""

    def put(
        self, row: ReconstructionRow, folder: DataFolder, rows: ReconstructionRepository, capture: CaptureRow
    ) -> ReconstructionRow:
        """Write it into the folder of a job of that capture; the row that says so.

        Raises UnknownIdError, ConfigurationError for poses that cannot be used, CalibrationError, and StoreError.
        """
        try:
            if self.poses is not None or self.poses_of is not None or self.calibration is not None:
                folder.reconstruction(row.id).mkdir(parents=True, exist_ok=True)
            if self.poses is not None:
                _write_poses(self.poses, folder.given_poses(row.id), capture)
                row = replace(row, poses_from=FROM_FILE)
            elif self.poses_of is not None:
                _path_of(self.poses_of, row.capture_id, folder, rows).write_tum(folder.given_poses(row.id))
                row = replace(row, poses_from=self.poses_of)
            if self.calibration is not None:
                Calibration.read(self.calibration)
                shutil.copyfile(self.calibration, folder.given_calibration(row.id))
                row = replace(row, calibration_from=self.calibration_of)
        except OSError as error:
            raise StoreError(f"what the job was given cannot be kept: {error.strerror}") from error
        return row


def _write_poses(text: str, path: Path, capture: CaptureRow) -> None:
    path.write_text(text, encoding="utf-8")
    try:
        poses = Trajectory.read_tum(path)
    except SceneError as error:
        raise ConfigurationError(f"{error}".replace(str(path), "the poses")) from error
    given = GivenPoses(poses, 1.0 if capture.sensor is None else capture.sensor.frame_rate_hz)
    if capture.sensor is not None and capture.recording is not None:
        given.check(capture.recording.first_frame + capture.recording.frames)


def _path_of(reconstruction_id: str, capture_id: str, folder: DataFolder, rows: ReconstructionRepository) -> Trajectory:
    row = rows.get(reconstruction_id)
    if row.capture_id != capture_id:
        raise ConfigurationError(f"reconstruction {row.id} is of another capture: its path is not that of this one")
    published = newest(folder.reconstruction(row.id))
    if published is None or published.poses < LEAST_POSES:
        raise ConfigurationError(f"reconstruction {row.id} has no path")
    poses = PoseFile(pose_file(folder.reconstruction(row.id), published))
    return poses.trajectory(range(len(poses)))
