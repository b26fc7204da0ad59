"""Versions of a scene and its trajectory: one process publishes them, others read them at any time."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from spiked.lens import lens_of
from spiked.poses import PoseAppender
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory
from spiked.whole_files import write_atomically
from spiked_service.results.published import OtherPath, Published
from spiked_service.results.shown_scene import TOLERANCE, ShownScene
from spiked_service.store.rows import VersionRow

_NEWEST = 3
"""Newest versions, always kept, so that the files exist for readers that have just read the index."""
_EARLIER = 16
"""Earlier versions kept, spread over time; at twice as many, every second one is removed."""
INDEX = "published.json"
"""File that lists the versions, replaced after their files are written."""


class _Index(BaseModel):
    versions: list[Published]
    """Oldest first; never empty."""


@dataclass(frozen=True)
class RecordedPath:
    """The path of the recording of a capture through a scene."""

    capture_id: str
    frame_rate_hz: float
    trajectory: Trajectory

    def published(self, name: str) -> OtherPath:
        """Its metadata, with the name of its file."""
        return OtherPath(
            capture_id=self.capture_id,
            frame_rate_hz=self.frame_rate_hz,
            trajectory=name,
            poses=len(self.trajectory),
        )


def moved_paths(paths: Sequence[RecordedPath], moved: Trajectory) -> list[RecordedPath]:
    """Paths with other poses: `moved` has those of all, one path after the other."""
    begins = np.cumsum([0, *(len(one.trajectory) for one in paths)])
    return [
        replace(
            one,
            trajectory=Trajectory(one.trajectory.times_s, moved.rotations[begin:end], moved.centres[begin:end]),
        )
        for one, begin, end in zip(paths, begins, begins[1:], strict=False)
    ]


class Publisher:
    """Writes numbered versions into a folder; numbers continue after those in the folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._versions = [one for one in versions(folder) if is_whole(folder, one)]
        self._protected: set[int] = set()
        self._shown = ShownScene()

    @property
    def folder(self) -> Path:
        """Folder of the versions."""
        return self._folder

    @property
    def version(self) -> int:
        """Number of the newest version; 0: none yet."""
        return self._versions[-1].version if self._versions else 0

    @property
    def kept(self) -> list[int]:
        """Numbers of the available versions."""
        return [published.version for published in self._versions]

    @property
    def versions(self) -> list[Published]:
        """The available versions, oldest first."""
        return self._versions

    def protect_newest(self) -> None:
        """Keep the current newest version for the life of this process."""
        if self._versions:
            self._protected.add(self.version)

    def again(self, earlier: Published, scene: Scene | None = None) -> Published:
        """Publish an earlier version under the next number, with another scene if one is given.

        Raises OSError as `publish` does.
        """
        version = self.version + 1
        names = {"scene": f"scene-{version:06d}.ply", "trajectory": f"trajectory-{version:06d}.poses"}
        edited: dict[str, Any] = {}
        content = (self._folder / earlier.scene).read_bytes() if scene is None else scene.ply(earlier.white)
        if scene is not None:
            edited = {
                "splats": len(scene),
                "scene_bytes": len(content),
                "psnr_db": None,
                "cleaned_from": earlier.version,
            }
        shown = scene or Scene.read_ply(self._folder / earlier.scene)
        paths = [
            one.model_copy(update={"trajectory": f"path-{version:06d}-{number}.poses"})
            for number, one in enumerate(earlier.paths, 1)
        ]
        with self._listed(version):
            slots = self._write_slots(shown, earlier.white, version, tolerance=0.0)
            published = earlier.model_copy(
                update={"version": version, "at": datetime.now(UTC), "paths": paths, **names, **slots, **edited}
            )
            write_atomically(self._folder / published.scene, content)
            for old, new in zip(earlier.paths, paths, strict=True):
                write_atomically(self._folder / new.trajectory, (self._folder / old.trajectory).read_bytes())
            write_atomically(self._folder / published.trajectory, pose_file(self._folder, earlier).read_bytes())
            self._list(published)
        return published

    def publish(
        self,
        scene: Scene,
        trajectory: Trajectory,
        white: float,
        psnr_db: float | None = None,
        intrinsics: Intrinsics | None = None,
        states: NDArray[np.bytes_] | None = None,
        tolerance: float = TOLERANCE,
        posed_frames: int | None = None,
        others: Sequence[RecordedPath] = (),
    ) -> Published:
        """Publish the next version and remove old ones; `states` [n] is the tracking state at each pose, `tolerance`
        that of `ShownScene.update`. `posed_frames` have a pose, if the trajectory has only some of them. `others` are
        paths of other recordings through the scene.

        Raises OSError if it cannot be written.
        """
        version = self.version + 1
        content = scene.ply(white)
        with self._listed(version):
            published = Published(
                version=version,
                white=white,
                scene=f"scene-{version:06d}.ply",
                trajectory=f"trajectory-{version:06d}.poses",
                at=datetime.now(UTC),
                splats=len(scene),
                poses=len(trajectory) if posed_frames is None else posed_frames,
                scene_bytes=len(content),
                psnr_db=psnr_db,
                intrinsics=None if intrinsics is None else (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy),
                distortion=None if intrinsics is None else lens_of(intrinsics.distortion),
                **self._write_slots(scene, white, version, tolerance),
                paths=[one.published(f"path-{version:06d}-{number}.poses") for number, one in enumerate(others, 1)],
            )
            for path, one in zip(published.paths, others, strict=True):
                _write_poses(self._folder / path.trajectory, one.trajectory, None)
            write_atomically(self._folder / published.scene, content)
            _write_poses(self._folder / published.trajectory, trajectory, states)
            self._list(published)
        return published

    @contextmanager
    def _listed(self, version: int) -> Iterator[None]:
        """Remove what was written of a version if it does not come to be listed: on a full disk, space counts."""
        try:
            yield
        except OSError:
            if self.version != version:
                for file in self._folder.glob(f"*-{version:06d}*"):
                    file.unlink(missing_ok=True)
            raise

    def _write_slots(self, scene: Scene, white: float, version: int, tolerance: float) -> dict[str, Any]:
        """Bring the slots up to date and write them. Return what `Published` says of them."""
        self._shown.update(scene, white, version, tolerance)
        name = f"scene-{version:06d}.slots"
        self._shown.write(self._folder / name)
        return {"slots": name, "slots_began": self._shown.began}

    def _list(self, published: Published) -> None:
        kept = _thinned([*self._versions, published], self._protected)
        without_slots = [one.model_copy(update={"slots": None}) for one in kept[:-_NEWEST]]
        kept = without_slots + kept[-_NEWEST:]
        _write_index(self._folder, kept)
        earlier, self._versions = self._versions, kept
        gone = {one.version: one for one in earlier}.keys() - {one.version for one in kept}
        slots = {one.slots for one in kept}
        for one in earlier:
            if one.slots is not None and one.slots not in slots:
                (self._folder / one.slots).unlink(missing_ok=True)
            if one.version in gone:
                for name in _names_of(one):
                    (self._folder / name).unlink(missing_ok=True)


def pose_file(folder: Path, published: Published) -> Path:
    """The pose file of a version; for one of an older release it is written at the first read."""
    return (folder / published.trajectory).with_suffix(".poses")


def _names_of(published: Published) -> set[str]:
    """Names of the files of a version."""
    poses = {published.trajectory, pose_file(Path(), published).name, *(one.trajectory for one in published.paths)}
    return {published.scene} | poses | (set() if published.slots is None else {published.slots})


def version_row(reconstruction_id: str, published: Published) -> VersionRow:
    """The catalogue row of a version."""
    return VersionRow(
        reconstruction_id,
        published.version,
        published.at,
        published.splats,
        published.poses,
        published.white,
        published.scene_bytes,
        published.psnr_db,
    )


def _write_poses(path: Path, trajectory: Trajectory, states: NDArray[np.bytes_] | None) -> None:
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    with PoseAppender(part) as file:
        file.append(trajectory, states)
        file.sync()
    part.replace(path)


def _thinned(published: list[Published], held: set[int]) -> list[Published]:
    earlier, newest = published[:-_NEWEST], published[-_NEWEST:]
    if len(earlier) >= 2 * _EARLIER:
        earlier = [one for n, one in enumerate(earlier) if n % 2 == 0 or one.version in held]
    return earlier + newest


def versions(folder: Path) -> list[Published]:
    """The versions in a folder, oldest first."""
    try:
        return _Index.model_validate_json((folder / INDEX).read_bytes()).versions
    except FileNotFoundError:
        return []


def is_whole(folder: Path, published: Published) -> bool:
    """Whether the files of a version are there, the scene with the size that it had."""
    scene, paths = folder / published.scene, [folder / one.trajectory for one in published.paths]
    posed = (folder / published.trajectory).is_file() or pose_file(folder, published).is_file()
    whole = scene.is_file() and scene.stat().st_size == published.scene_bytes
    return whole and posed and all(path.is_file() for path in paths)


def forget_incomplete(folder: Path) -> list[int]:
    """List only versions that are whole. Return the numbers of the others. Nobody may publish meanwhile."""
    return _forget(folder, lambda one: not is_whole(folder, one))


def forget_with(folder: Path, names: Collection[str]) -> list[int]:
    """List no version with one of these files, before they are replaced or removed. Return their numbers."""
    return _forget(folder, lambda one: not _names_of(one).isdisjoint(names))


def _forget(folder: Path, is_gone: Callable[[Published], bool]) -> list[int]:
    listed = versions(folder)
    kept = [one for one in listed if not is_gone(one)]
    if len(kept) < len(listed):
        _write_index(folder, kept)
    return [one.version for one in listed if one not in kept]


def _write_index(folder: Path, kept: list[Published]) -> None:
    if kept:
        write_atomically(folder / INDEX, _Index(versions=kept).model_dump_json().encode())
    else:
        (folder / INDEX).unlink()


def newest(folder: Path) -> Published | None:
    """The newest version in a folder, None before the first."""
    found = versions(folder)
    return found[-1] if found else None


def at(folder: Path, version: int | None) -> Published | None:
    """The version with this number, the newest if None. Return None if it does not exist yet or was removed."""
    if version is None:
        return newest(folder)
    return next((one for one in versions(folder) if one.version == version), None)
