"""Output folders of `spiked reconstruct` and `spiked merge`, read back as maps, and those of several recordings."""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from spiked.errors import ConfigurationError, SceneError
from spiked.lens import Lens, distortion_of
from spiked.recon import KnownMap
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory
from spiked_service.results.scene_scale import remove_scale

MAP_FILES = ("report.json", "scene.ply", "trajectory.tum")
"""Files of a map."""
PATHS = "paths"
"""Folder with the path of each recording, in the folder of a map of several."""
EVALUATION = "evaluation.json"
"""In an output folder: the figures of `spiked evaluate --json`."""
_REPORT = "report.json"
_MAKING = ".making-"
"""Names of folders with files that are not whole yet begin so."""


@dataclass(frozen=True)
class MapFolder:
    """A scene, the paths through it, and the camera that made them."""

    scene: Scene
    trajectory: Trajectory
    """Of the recording that gave the frame of reference, or of the newest one."""
    width: int
    """Of the camera's images, in pixels."""
    height: int
    intrinsics: Intrinsics
    paths: dict[str, Trajectory] = field(default_factory=dict)
    """The path of each recording by its name; of one recording by the folder's."""
    versions: dict[str, str] = field(default_factory=dict)
    """Of the programs that made the map."""
    outcome: str = "complete"
    """Of the run that made it, or that it was interrupted or cut short."""

    @classmethod
    def read(cls, folder: Path) -> "MapFolder":
        """Read scene.ply, trajectory.tum, the paths of several recordings, and report.json. Raises SceneError."""
        if not folder.is_dir():
            raise SceneError(f"the map {folder} is not a folder; name the output folder of `spiked reconstruct`")
        for name in MAP_FILES:
            if not (folder / name).is_file():
                raise SceneError(f"{folder} has no {name}; name the output folder of `spiked reconstruct`")
        try:
            report = _Report.model_validate_json((folder / "report.json").read_bytes())
        except (OSError, ValueError) as error:
            raise SceneError(f"cannot read the camera of the map in {folder / 'report.json'}: {error}") from error
        if report.outcome == "failed":
            raise SceneError(f"{folder} holds a reconstruction that has failed: it is no map")
        sensor, (fx, fy) = report.sensor, report.focal_px
        cx, cy = report.principal_point_px or (sensor.width / 2, sensor.height / 2)
        scene, path = Scene.read_ply(folder / "scene.ply"), Trajectory.read_tum(folder / "trajectory.tum")
        paths = {one.name: Trajectory.read_tum(folder / PATHS / f"{one.name}.tum") for one in report.paths}
        intrinsics = Intrinsics(fx, fy, cx, cy, distortion_of(report.distortion))
        paths = paths or {file_name(folder.resolve().name): path}
        return cls(scene, path, sensor.width, sensor.height, intrinsics, paths, report.versions, report.outcome)

    @property
    def known(self) -> KnownMap:
        """The scene with all paths."""
        return KnownMap.of(self.scene, list(self.paths.values()), self.camera)

    @property
    def camera(self) -> Camera:
        """The camera of the first recording."""
        return Camera(self.intrinsics, self.width, self.height)


def names_of_both(first: Sequence[str], second: Sequence[str]) -> list[str]:
    """Names of the paths of two maps: those of the second get a number where the first has them too."""
    names = [file_name(name) for name in first]
    for wanted in map(file_name, second):
        others = (f"{wanted}-{number}" for number in count(2))
        names.append(next(name for name in chain([wanted], others) if name not in names))
    return names


def file_name(name: str) -> str:
    """A name as that of a file: letters, digits, `_`, `.` and `-`, and none that is hidden."""
    return re.sub(r"[^\w.-]", "_", name).lstrip(".")[:100] or "path"


def camera_in(sensor: Sensor, known: Camera) -> Camera:
    """The camera of a recording that is looked for in a map made by `known`, whose lens is assumed if none is stated.

    Raises ConfigurationError if that cannot be, because the images differ in size.
    """
    if sensor.intrinsics is None and (sensor.width, sensor.height) != (known.width, known.height):
        raise ConfigurationError(
            f"the recording is {sensor.width}x{sensor.height} and the map was made with {known.width}x{known.height}, "
            "so it is another camera: give its intrinsics (--fov or --intrinsics)"
        )
    return Camera(sensor.intrinsics or known.intrinsics, sensor.width, sensor.height)


def write_map(
    folder: Path, scene: Scene, trajectory: Trajectory, paths: Mapping[str, Trajectory], report: Mapping[str, object]
) -> None:
    """Write a map of several recordings, as `replacing` says. Raises OSError."""
    listed = {"paths": [{"name": name, "poses": len(path)} for name, path in paths.items()]}
    with replacing(folder) as making:
        scene.write_ply(making / "scene.ply")
        trajectory.write_tum(making / "trajectory.tum")
        (making / PATHS).mkdir()
        for name, path in paths.items():
            path.write_tum(making / PATHS / f"{name}.tum")
        (making / _REPORT).write_text(json.dumps({**report, **listed}, indent=1), encoding="utf-8")


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """A folder for the files of a new result, which take the place of those in `folder` when all are written.

    After an error the result before is whole; after a kill there is no report, and half a map is none. Nothing of a
    map before is left, with its scale, paths and evaluation; other files stay. Raises OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for left in folder.glob(f"{_MAKING}*"):
        shutil.rmtree(left, ignore_errors=True)  # of a command that was killed
    making = folder / f"{_MAKING}{os.getpid()}"
    making.mkdir()
    try:
        yield making
        (folder / _REPORT).unlink(missing_ok=True)
        for name in (*MAP_FILES, EVALUATION):
            if not (making / name).exists():
                (folder / name).unlink(missing_ok=True)
        remove_scale(folder)
        if (folder / PATHS).is_dir():
            shutil.rmtree(folder / PATHS)
        for file in sorted(making.iterdir(), key=lambda path: path.name == _REPORT):
            file.replace(folder / file.name)
    finally:
        shutil.rmtree(making, ignore_errors=True)


def joint_paths(
    first: Mapping[str, Trajectory], second: Mapping[str, Trajectory], moved: Trajectory
) -> dict[str, Trajectory]:
    """The paths of two maps in the first map's frame of reference, in which `moved` has those of the second."""
    names = names_of_both(list(first), list(second))
    begins = np.cumsum([0, *(len(path) for path in second.values())])
    there = [
        Trajectory(path.times_s, moved.rotations[begin : begin + len(path)], moved.centres[begin : begin + len(path)])
        for path, begin in zip(second.values(), begins, strict=False)
    ]
    return dict(zip(names, [*first.values(), *there], strict=True))


class _Sensor(BaseModel):
    width: int = Field(gt=0)
    height: int = Field(gt=0)


class _Path(BaseModel):
    name: str = Field(pattern=r"^\w[\w.-]*$")


class _Report(BaseModel):
    outcome: str
    sensor: _Sensor
    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float] | None = None
    distortion: Lens | None = None
    paths: list[_Path] = []
    versions: dict[str, str] = {}
