"""Versions of a scene and its trajectory, published by one process for others to read at any time."""

import os
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel

from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory

_NEWEST = 3
"""Versions always kept, so that a reader that has just read the index still finds its files."""
_EARLIER = 16
"""Earlier ones kept, spread over the whole time; with twice as many every second of them goes."""
_INDEX = "published.json"


class Published(BaseModel):
    """A version: its files lie beside the index."""

    version: int
    white: float
    """Radiance to be shown as white, spikes a frame."""
    scene: str
    trajectory: str
    at: datetime
    splats: int
    poses: int
    scene_bytes: int
    psnr_db: float | None = None
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy (px) that it was made with: given or estimated."""


class _Index(BaseModel):
    versions: list[Published]
    """Oldest first; never empty."""


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file in one step: a reader sees the old or the new content, never a part, after a power cut too."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fdatasync(file.fileno())
    part.replace(path)


class Publisher:
    """Writes numbered versions into a folder; in a folder that has some, it goes on with their numbers."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._versions = versions(folder)

    @property
    def version(self) -> int:
        """Number of the newest version, 0: none yet."""
        return self._versions[-1].version if self._versions else 0

    @property
    def kept(self) -> list[int]:
        """Numbers of the versions that can be read."""
        return [published.version for published in self._versions]

    def publish(
        self,
        scene: Scene,
        trajectory: Trajectory,
        white: float,
        psnr_db: float | None = None,
        intrinsics: Intrinsics | None = None,
    ) -> Published:
        """Make the next version the newest, and let go of old ones. Raises OSError when the disk does not take it."""
        version = self.version + 1
        content = scene.ply(white)
        published = Published(
            version=version,
            white=white,
            scene=f"scene-{version:06d}.ply",
            trajectory=f"trajectory-{version:06d}.tum",
            at=datetime.now(UTC),
            splats=len(scene),
            poses=len(trajectory),
            scene_bytes=len(content),
            psnr_db=psnr_db,
            intrinsics=None if intrinsics is None else (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy),
        )
        write_atomically(self._folder / published.scene, content)
        write_atomically(self._folder / published.trajectory, trajectory.tum().encode())
        kept = _thinned([*self._versions, published])
        write_atomically(self._folder / _INDEX, _Index(versions=kept).model_dump_json().encode())
        gone = {one.version: one for one in self._versions}.keys() - {one.version for one in kept}
        for one in self._versions:
            if one.version in gone:
                (self._folder / one.scene).unlink(missing_ok=True)
                (self._folder / one.trajectory).unlink(missing_ok=True)
        self._versions = kept
        return published


def _thinned(published: list[Published]) -> list[Published]:
    earlier, newest = published[:-_NEWEST], published[-_NEWEST:]
    if len(earlier) >= 2 * _EARLIER:
        earlier = earlier[::2]
    return earlier + newest


def versions(folder: Path) -> list[Published]:
    """The versions in a folder, oldest first."""
    try:
        return _Index.model_validate_json((folder / _INDEX).read_bytes()).versions
    except FileNotFoundError:
        return []


def newest(folder: Path) -> Published | None:
    """The newest version in a folder, None before the first."""
    found = versions(folder)
    return found[-1] if found else None


def at(folder: Path, version: int | None) -> Published | None:
    """That version, or the newest; None if it is not there, not yet or not any more."""
    if version is None:
        return newest(folder)
    return next((one for one in versions(folder) if one.version == version), None)
