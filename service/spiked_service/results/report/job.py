"""Reports of the jobs of the service: a published version, with what its worker and the catalogue say of it."""

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spiked.errors import RecordingError
from spiked.poses import PoseFile
from spiked.recon.environment import machine, versions
from spiked.recording import Recording, open_recording, sidecar_path
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory
from spiked_service.results.map_reports import LOCALISATION, REGISTRATION, REPORT
from spiked_service.results.published import Published
from spiked_service.results.report.figures import Figures
from spiked_service.results.report.source import Pieces, Render, ReportSource, pairs, thinned, without_folders
from spiked_service.results.timeline import STATES, Timeline, known
from spiked_service.store.rows import CaptureRow, JobState, ReconstructionRow, Task

_PIECE = 4096
"""Poses in memory at a time."""


@dataclass(frozen=True)
class JobReport:
    """Reads a version of a job."""

    row: ReconstructionRow
    capture: CaptureRow
    folder: Path
    """Of the job."""
    published: Published
    poses: PoseFile
    sensor: Sensor | None
    """With the optics of the version."""
    timeline: Path
    recording: Path
    """Where the recording of the capture is, if there is one that is closed."""
    render: Render | None
    with_recording: bool = False

    def read(self) -> ReportSource:
        """Raises SceneError."""
        document = without_folders(self._document())
        poses, published = self.poses, self.published
        path = _part(poses, thinned(len(poses)))
        recording = self._recording()
        first_frame = 0 if self.capture.recording is None else self.capture.recording.first_frame
        sidecar = sidecar_path(self.recording)
        return ReportSource(
            name=self.capture.name or f"reconstruction {self.row.id}",
            document=document,
            figures=Figures.read(document, f"the report of reconstruction {self.row.id}"),
            at=published.at,
            path=path,
            poses=len(poses),
            pieces=_pieces(poses),
            tum=None,
            sensor=self.sensor,
            incomplete=self._incomplete(),
            recording_name="" if recording is None else f"capture {self.capture.id}",
            scene=self.folder / published.scene,
            pairs=pairs(path, published.white, self.render, recording, first_frame),
            others={one.capture_id: _pieces(PoseFile(self.folder / one.trajectory)) for one in published.paths},
            sidecar=sidecar if recording is not None and sidecar.is_file() else None,
            recording=self.recording if self.with_recording and recording is not None else None,
        )

    def _document(self) -> dict[str, Any]:
        """What report.json of an output folder has, and the job."""
        row, published, timeline = self.row, self.published, Timeline.read(self.timeline)
        own = _json(self.folder / REPORT)
        maps = {
            Task.EXTEND: ("extended", REGISTRATION),
            Task.MERGE: ("merged", REGISTRATION),
            Task.LOCALISE: ("localisation", LOCALISATION),
        }
        name, file = maps.get(row.task, ("", ""))
        joint = {name: found} if name and (found := _json(self.folder / file)) else {}
        return {
            "versions": versions(),
            "machine": machine(),
            "frames": row.frames or None,
            **_of_timeline(timeline),
            "options": row.options.model_dump(mode="json"),
            **own,
            **self._camera(),
            "outcome": str(row.state),
            "reason": row.reason,
            "warnings": list(row.warnings),
            "splats": published.splats,
            "poses": published.poses,
            "psnr_db": published.psnr_db,
            **joint,
            "paths": [{"name": one.capture_id, "poses": one.poses} for one in published.paths],
            "job": {
                "reconstruction": row.id,
                "capture": row.capture_id,
                "task": str(row.task),
                "version": published.version,
                "published": published.at.isoformat(),
                "started": None if row.started_at is None else row.started_at.isoformat(),
                "ended": None if row.ended_at is None else row.ended_at.isoformat(),
                "attempts": row.attempts,
            },
        }

    def _camera(self) -> dict[str, Any]:
        """Size, rate and the lens of the version."""
        if self.sensor is None:
            return {}
        sensor, lens = self.sensor, self.sensor.intrinsics
        found: dict[str, Any] = {
            "sensor": {"width": sensor.width, "height": sensor.height, "frame_rate_hz": sensor.frame_rate_hz}
        }
        if lens is not None:
            found |= {"focal_px": [lens.fx, lens.fy], "principal_point_px": [lens.cx, lens.cy]}
        if lens is not None and lens.distortion is not None:
            found["distortion"] = {"model": str(lens.distortion.model), **lens.distortion.named()}
        return found

    def _incomplete(self) -> str | None:
        row, version = self.row, self.published.version
        if not row.state.over:
            return f"The job is {row.state}, at stage {row.stage}: version {version} is a result on the way."
        if row.state is not JobState.COMPLETE:
            why = f": {row.reason}" if row.reason else ""
            return f"The job was {row.state}{why}. Version {version} is what it had published."
        if version != row.version:
            return f"This is version {version}; the newest is {row.version}, and figures over time are of its run."
        return None

    def _recording(self) -> Recording | None:
        """The recording of the capture, for pictures."""
        if self.capture.recording is None or self.capture.state.acquiring:
            return None
        with suppress(RecordingError):
            return open_recording(self.recording)
        return None


def _of_timeline(timeline: Timeline) -> dict[str, Any]:
    """Views, gaps and closed loops, for a job whose worker has not written its report."""
    moments = timeline.moments
    columns = {name: known(moments[name].tolist()) for name in ("chi2", "sigma_px", "rate")}
    views = [
        {"time_s": time_s, "state": str(STATES[state]), **{name: column[row] for name, column in columns.items()}}
        for row, (time_s, state) in enumerate(zip(moments["time_s"].tolist(), moments["state"].tolist(), strict=True))
    ]
    return {
        "views": views,
        "gaps": [{"first_frame": gap.first, "frames": gap.count} for gap in timeline.gaps],
        "closures": [closure.model_dump() for closure in timeline.closures],
    }


def _json(path: Path) -> dict[str, Any]:
    """Empty if there is none that can be read: a job of an older release, or one that has not ended."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _part(poses: PoseFile, rows: range) -> Trajectory:
    if not rows:
        return Trajectory.empty()
    return poses.trajectory(rows)


def _pieces(poses: PoseFile) -> Pieces:
    rows = range(len(poses))

    def pieces() -> Iterator[Trajectory]:
        return (poses.trajectory(rows[first : first + _PIECE]) for first in range(0, len(rows), _PIECE))

    return pieces
