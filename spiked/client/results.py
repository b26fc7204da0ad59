"""What reconstructions have published: versions, timelines, trajectories, scenes, pictures."""

from collections.abc import Sequence
from pathlib import Path

from spiked.client.connection import Connection, plain
from spiked.client.models import (
    ImageFormat,
    IntrinsicsModel,
    Output,
    SceneFormat,
    TimelineOut,
    TrajectoryFormat,
    TrajectoryOut,
    VersionOut,
    VersionsOut,
)
from spiked.scene_changes import SceneChanges, SceneMirror

_PIECE_BYTES = 1 << 20
"""Bytes of a download that are written at a time."""


class ResultMethods:
    """What `Spiked` reads of reconstructions."""

    _connection: Connection

    def versions(self, reconstruction_id: str) -> list[VersionOut]:
        """The versions that are kept, oldest first."""
        return self._connection.get(f"reconstructions/{reconstruction_id}/versions", VersionsOut).items

    def timeline(
        self,
        reconstruction_id: str,
        *,
        from_s: float | None = None,
        to_s: float | None = None,
        points: int | None = None,
    ) -> TimelineOut:
        """How it went, or a part of it; neighbouring views are joined to at most `points`."""
        path = f"reconstructions/{reconstruction_id}/timeline"
        return self._connection.get(path, TimelineOut, from_s=from_s, to_s=to_s, points=points)

    def trajectory(
        self,
        reconstruction_id: str,
        *,
        version: int | None = None,
        from_s: float | None = None,
        to_s: float | None = None,
        step: int | None = None,
        path: int | None = None,
    ) -> TrajectoryOut:
        """Poses of a version, the newest if none is given; from_s <= time < to_s, every step-th.

        `path` is that of another recording of its map, see `paths`.
        """
        url = f"reconstructions/{reconstruction_id}/trajectory"
        query = {"version": version, "from_s": from_s, "to_s": to_s, "step": step, "path": path}
        return self._connection.get(url, TrajectoryOut, **query)

    def trajectory_file(
        self, reconstruction_id: str, kind: TrajectoryFormat = TrajectoryFormat.tum, *, version: int | None = None
    ) -> bytes:
        """The trajectory as a file; COLMAP's is a ZIP."""
        query = {"format": kind, "version": version}
        return self._connection.request("GET", f"reconstructions/{reconstruction_id}/trajectory", query=query).content

    def scene(
        self,
        reconstruction_id: str,
        kind: SceneFormat = SceneFormat.ply,
        *,
        version: int | None = None,
        max_splats: int | None = None,
    ) -> bytes:
        """The scene as a file; a fixed sample of it with max_splats."""
        query = {"format": kind, "version": version, "max_splats": max_splats}
        return self._connection.request("GET", f"reconstructions/{reconstruction_id}/scene", query=query).content

    def report(self, reconstruction_id: str, *, version: int | None = None) -> str:
        """A version as one HTML file, which opens offline."""
        path = f"reconstructions/{reconstruction_id}/report"
        return self._connection.request("GET", path, query={"version": version}).text

    def save_bundle(
        self, reconstruction_id: str, path: Path | str, *, version: int | None = None, recording: bool = False
    ) -> Path:
        """Write a version as one ZIP: report, scene, trajectory in four formats, pictures; with `recording` frames."""
        path = Path(path)
        part = path.with_name(f".{path.name}.part")
        try:
            with (
                self._connection.stream(
                    f"reconstructions/{reconstruction_id}/bundle", version=version, recording=recording or None
                ) as answer,
                part.open("wb") as file,
            ):
                for chunk in answer.iter_bytes(_PIECE_BYTES):
                    file.write(chunk)
            return part.replace(path)
        finally:
            part.unlink(missing_ok=True)

    def update_scene(self, reconstruction_id: str, mirror: SceneMirror, *, level: int | None = None) -> SceneChanges:
        """Bring a mirror of the scene to its newest version; only what has visibly changed since the last call travels.

        `level` 0 has a sixteenth of the splats, 1 a quarter, 2 all. Return what changed.
        """
        query = {"since": mirror.state, "level": level}
        answer = self._connection.request("GET", f"reconstructions/{reconstruction_id}/scene/changes", query=query)
        changes = SceneChanges.read(answer.content)
        mirror.apply(changes)
        return changes

    def view(
        self,
        reconstruction_id: str,
        *,
        frame: int | None = None,
        position: Sequence[float] | None = None,
        quaternion_wxyz: Sequence[float] | None = None,
        c2w: Sequence[Sequence[float]] | None = None,
        size: tuple[int, int] | None = None,
        intrinsics: IntrinsicsModel | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        output: Output = Output.color,
        white: float | None = None,
        kind: ImageFormat = ImageFormat.png,
        version: int | None = None,
    ) -> bytes:
        """An encoded picture from a pose: that of a frame, or position and quaternion_wxyz, or a 4x4 matrix."""
        pose = {"frame": frame, "position": position, "quaternion_wxyz": quaternion_wxyz, "c2w": c2w}
        body = {
            "camera": {key: value for key, value in pose.items() if value is not None},
            "intrinsics": plain(intrinsics),
            "background": background,
            "output": output,
            "white": white,
        }
        if size is not None:
            body |= {"width": size[0], "height": size[1]}
        path, query = f"reconstructions/{reconstruction_id}/views", {"format": kind, "version": version}
        return self._connection.request("POST", path, query=query, json=body).content
