"""Versions of a scene and its trajectory, published by one process for others to read at any time."""

from pathlib import Path

from pydantic import BaseModel

from spiked.scene import Scene
from spiked.trajectory import Trajectory

_KEPT = 3
"""Versions kept on disk, so that a reader that has just read the index still finds its files."""
_INDEX = "published.json"


class Published(BaseModel):
    """The newest version: its files lie beside the index."""

    version: int
    white: float
    """Radiance to be shown as white, spikes a frame."""
    scene: str
    trajectory: str


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file in one step: a reader sees the old or the new content, never a part."""
    part = path.with_name(path.name + ".part")
    part.write_bytes(content)
    part.replace(path)


class Publisher:
    """Writes numbered versions into a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.version = 0

    def publish(self, scene: Scene, trajectory: Trajectory, white: float) -> None:
        """Make the next version the newest, and let go of old ones."""
        version = self.version + 1
        index = Published(
            version=version,
            white=white,
            scene=f"scene-{version:06d}.ply",
            trajectory=f"trajectory-{version:06d}.tum",
        )
        write_atomically(self._folder / index.scene, scene.ply(white))
        write_atomically(self._folder / index.trajectory, trajectory.tum().encode())
        write_atomically(self._folder / _INDEX, index.model_dump_json().encode())
        self.version = version
        for name in (f"scene-{version - _KEPT:06d}.ply", f"trajectory-{version - _KEPT:06d}.tum"):
            (self._folder / name).unlink(missing_ok=True)


def newest(folder: Path) -> Published | None:
    """The newest version in a folder, None before the first."""
    try:
        return Published.model_validate_json((folder / _INDEX).read_bytes())
    except FileNotFoundError:
        return None
