"""Maps that a job uses, linked into its folder: what becomes of the reconstructions does not change or remove them."""

import os
import shutil
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from spiked.errors import ConfigurationError
from spiked.lens import Lens, distortion_of, lens_of
from spiked.poses import PoseFile
from spiked.recon import KnownMap
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked_service.results.published import OtherPath, Published
from spiked_service.results.versions import RecordedPath, pose_file
from spiked_service.store.rows import ReconstructionRow

_ABOUT = "map.json"
_SCENE = "scene.ply"


class PinnedMap(BaseModel):
    """A version of a reconstruction as a map; the files are beside its metadata."""

    reconstruction_id: str
    version: int
    width: int
    """Of the camera's images, in pixels."""
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Lens | None = None
    """Of the lens."""
    paths: list[OtherPath]
    """Of all recordings, that of its own capture first."""

    @classmethod
    def read(cls, folder: Path) -> "PinnedMap":
        """Raises ConfigurationError if there is none."""
        try:
            return cls.model_validate_json((folder / _ABOUT).read_bytes())
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"{folder} holds no map: {error}; submit the job again") from error

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the camera of its own recording."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, distortion_of(self.distortion))

    def recorded(self, folder: Path) -> list[RecordedPath]:
        """The paths of all recordings. Raises SceneError."""
        files = [PoseFile(folder / one.trajectory) for one in self.paths]
        return [
            RecordedPath(one.capture_id, one.frame_rate_hz, file.trajectory(range(len(file))))
            for one, file in zip(self.paths, files, strict=True)
        ]

    def known(self, folder: Path) -> KnownMap:
        """The scene with all paths. Raises SceneError."""
        scene, paths = Scene.read_ply(folder / _SCENE), [one.trajectory for one in self.recorded(folder)]
        return KnownMap.of(scene, paths, Camera(self.intrinsics, self.width, self.height))


def pin(folder: Path, row: ReconstructionRow, source: Path, published: Published, sensor: Sensor) -> None:
    """Link a version of a reconstruction, in the folder `source`, into `folder`; `sensor` is that of its capture.

    Raises ConfigurationError for a version of an old release, OSError if files cannot be linked or copied.
    """
    optics = published.optics(sensor)
    own = OtherPath(
        capture_id=row.capture_id,
        frame_rate_hz=sensor.frame_rate_hz,
        trajectory=pose_file(source, published).name,
        poses=published.poses,
    )
    about = PinnedMap(
        reconstruction_id=row.id,
        version=published.version,
        width=sensor.width,
        height=sensor.height,
        fx=optics.fx,
        fy=optics.fy,
        cx=optics.cx,
        cy=optics.cy,
        distortion=lens_of(optics.distortion),
        paths=[own, *published.paths],
    )
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    _link(source / published.scene, folder / _SCENE)
    for path in about.paths:
        _link(source / path.trajectory, folder / path.trajectory)
    (folder / _ABOUT).write_text(about.model_dump_json(), encoding="utf-8")


def _link(source: Path, target: Path) -> None:
    """Give a file a second name; where the disk knows none, copy it."""
    with suppress(OSError):
        os.link(source, target)
        return
    shutil.copyfile(source, target)
