"""Reports of the output folders of `spiked reconstruct`, `localise` and `merge`."""

import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import CheckpointError, SceneError, SpikedError
from spiked.export import ExportSource
from spiked.recon.checkpoint import Interrupted
from spiked.recon.checkpoint_file import CHECKPOINT, exists
from spiked.recording import Recording, open_recording, sidecar_path
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.trajectory import Trajectory
from spiked_service.results.map_folder import EVALUATION, PATHS
from spiked_service.results.map_reports import LOCALISATION, REPORT, recorded_geometry
from spiked_service.results.report.figures import Figures
from spiked_service.results.report.source import Pieces, Render, ReportSource, pairs, thinned, without_folders
from spiked_service.results.scene_scale import read_scale
from spiked_service.results.view_renderer import Pose


@dataclass(frozen=True)
class FolderReport:
    """Reads an output folder."""

    folder: Path
    recording: Path | None = None
    """Where the recording is, if not where the run found it."""
    evaluation: Path | None = None
    """Figures of `spiked evaluate --json`, if not in the folder."""
    with_recording: bool = False
    made: Path | None = None
    """Where the results are, if not in the folder: see `results_on_the_way`."""

    @property
    def _files(self) -> Path:
        return self.made or self.folder

    def read(self) -> ReportSource:
        """Raises SceneError and RecordingError."""
        document = self._document()
        shared = without_folders(document)
        figures = Figures.read(shared, str(self.folder / REPORT))
        trajectory = self._trajectory()
        place = self._recording_place(document)
        recording = None if place is None else self._open(place, document)
        scene = self._files / "scene.ply"
        splats = Scene.read_ply(scene) if scene.is_file() else None
        drawn = thinned(len(trajectory))
        path = Trajectory(*(part[drawn] for part in (trajectory.times_s, trajectory.rotations, trajectory.centres)))
        others = {name: self._pieces(name) for name in self._path_names(document)}
        sidecar = None if place is None or not sidecar_path(place).is_file() else sidecar_path(place)
        return ReportSource(
            name=self.folder.resolve().name,
            document=shared,
            figures=figures,
            at=self._at(),
            path=path,
            poses=len(trajectory),
            pieces=lambda: [trajectory],
            tum=self._files / "trajectory.tum",
            sensor=figures.described_sensor,
            incomplete=self._incomplete(),
            recording_name=document.get("recording", {}).get("file", "") if place is None else place.name,
            scene=scene if splats is not None else None,
            pairs=pairs(path, 1.0 if splats is None else splats.colour_of_white, _renderer(splats, figures), recording),
            others=others,
            sidecar=sidecar,
            recording=place if self.with_recording else None,
        )

    def export_source(self) -> ExportSource:
        """The result for exports. Raises SceneError and RecordingError."""
        document = self._document()
        figures = Figures.read(without_folders(document), str(self.folder / REPORT))
        place, scene = self._recording_place(document), self._files / "scene.ply"
        recording = None if place is None else self._open(place, document)
        sensor = figures.described_sensor
        if sensor is not None and recording is not None:
            sensor = replace(recording.sensor, intrinsics=sensor.intrinsics)
        return ExportSource(
            path=self._trajectory(),
            sensor=sensor,
            scene=Scene.read_ply(scene) if scene.is_file() else None,
            recording=recording,
            name=self.folder.resolve().name,
            scale=read_scale(self.folder).known,
        )

    def _document(self) -> dict[str, Any]:
        """The content of report.json, with the figures of `evaluate` and `localise`."""
        if not self.folder.is_dir():
            raise SceneError(f"{self.folder} is not a folder; name the output folder of `spiked reconstruct`")
        localised = _json(self.folder / LOCALISATION)
        document = _json(self._files / REPORT) or localised
        if document is None:
            raise SceneError(
                f"{self.folder} has no {REPORT}: name the output folder of `spiked reconstruct`, `merge` or `localise`"
            )
        evaluation = _json(self.evaluation or self.folder / EVALUATION)
        if self.evaluation is not None and evaluation is None:
            raise SceneError(f"{self.evaluation} does not exist: write it with `spiked evaluate --json`")
        return document | ({} if evaluation is None else {"evaluation": evaluation})

    def _incomplete(self) -> str | None:
        """Why the results are not the end of the run."""
        if not exists(self.folder / CHECKPOINT):
            return None
        try:
            stage = f" ({Interrupted.read(self.folder / CHECKPOINT).stage})"
        except CheckpointError:
            stage = ""
        return (
            f"The run was interrupted or is not over{stage}: these are results on the way. "
            "spiked reconstruct --resume completes it."
        )

    def _trajectory(self) -> Trajectory:
        file = self._files / "trajectory.tum"
        try:
            return Trajectory.read_tum(file)
        except SceneError:
            if not file.exists() or any(not line.startswith("#") for line in file.read_text().splitlines()):
                raise
            return Trajectory.empty()  # none was found

    def _at(self) -> datetime:
        files = [file for file in (self._files / REPORT, self._files / LOCALISATION) if file.exists()]
        return datetime.fromtimestamp(files[0].stat().st_mtime, UTC)

    def _recording_place(self, document: dict[str, Any]) -> Path | None:
        """The recording of the run, if it is still there. Raises SceneError for one that was named and is not."""
        if self.recording is not None:
            if not self.recording.is_file():
                raise SceneError(f"--recording {self.recording} does not exist: name the recording of {self.folder}")
            return self.recording
        said = document.get("recording", {})
        named = isinstance(said.get("folder"), str) and isinstance(said.get("file"), str)
        place = Path(said["folder"], said["file"]) if named else None
        if place is not None and place.is_file():
            return place
        if self.with_recording:
            raise SceneError(f"the recording of {self.folder} is not known: name it with --recording FILE")
        return None

    def _open(self, place: Path, document: dict[str, Any]) -> Recording | None:
        """The recording for pictures; None if it cannot be opened as the run did. Raises if it was named."""
        try:
            return open_recording(place, **recorded_geometry(document.get("recording", {})).stated())
        except (SpikedError, ValueError):
            if self.recording is not None:
                raise
            return None

    def _path_names(self, document: dict[str, Any]) -> list[str]:
        names = [Path(str(one.get("name", ""))).name for one in document.get("paths", [])]
        return [name for name in names if (self.folder / PATHS / f"{name}.tum").is_file()]

    def _pieces(self, name: str) -> Pieces:
        return lambda: [Trajectory.read_tum(self.folder / PATHS / f"{name}.tum")]


def _json(path: Path) -> dict[str, Any] | None:
    """None if there is no such file. Raises SceneError for one that is no JSON object."""
    try:
        found = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise SceneError(f"{path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise SceneError(f"{path} holds no JSON object; name a folder of results of this program")
    return found


def _renderer(splats: Scene | None, figures: Figures) -> Render | None:
    camera = figures.camera
    if splats is None or camera is None or not len(splats):
        return None
    rasteriser = Rasteriser(camera)

    def render(pose: Pose) -> NDArray[np.float32]:
        return np.array(rasteriser.forward(splats, pose.rotation[None], pose.centre[None]).values)

    return render
