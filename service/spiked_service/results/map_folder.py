"""The output folder of `spiked reconstruct`, read back as a map."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel

from spiked.errors import SceneError
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory


@dataclass(frozen=True)
class MapFolder:
    """A scene, the path through it, and the camera that made them."""

    scene: Scene
    trajectory: Trajectory
    width: int
    """Of the camera's images, in pixels."""
    height: int
    intrinsics: Intrinsics

    @classmethod
    def read(cls, folder: Path) -> "MapFolder":
        """Read scene.ply, trajectory.tum and report.json. Raises SceneError."""
        if not folder.is_dir():
            raise SceneError(f"the map {folder} is not a folder; name the output folder of `spiked reconstruct`")
        for name in ("report.json", "scene.ply", "trajectory.tum"):
            if not (folder / name).is_file():
                raise SceneError(f"{folder} has no {name}; name the output folder of `spiked reconstruct`")
        try:
            report = _Report.model_validate_json((folder / "report.json").read_bytes())
        except (OSError, ValueError) as error:
            raise SceneError(f"cannot read the camera of the map in {folder / 'report.json'}: {error}") from error
        if report.outcome != "complete":
            raise SceneError(f"{folder} holds a reconstruction that has {report.outcome}: it is no map")
        sensor, (fx, fy) = report.sensor, report.focal_px
        intrinsics = Intrinsics(fx, fy, sensor.width / 2, sensor.height / 2)
        scene, path = Scene.read_ply(folder / "scene.ply"), Trajectory.read_tum(folder / "trajectory.tum")
        return cls(scene, path, sensor.width, sensor.height, intrinsics)


class _Sensor(BaseModel):
    width: int
    height: int


class _Report(BaseModel):
    outcome: str
    sensor: _Sensor
    focal_px: tuple[float, float]
