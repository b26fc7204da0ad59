"""Published versions over HTTP: scenes and trajectories of reconstructions and of captures."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from fastapi import Request, Response

from spiked import spz
from spiked.errors import SceneError
from spiked.frame_of_reference import FrameOfReference, KnownScale
from spiked.poses import PoseFile
from spiked.render import Camera
from spiked.scene import Scene
from spiked.scene_changes import SceneChanges
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory
from spiked_service.api import files
from spiked_service.api.problems import GoneError, NothingError, NotReadyError
from spiked_service.api.trajectories import Range, TrajectoryFormat, open_poses, trajectory_response
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.captures.captures import Captures
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.published import Published
from spiked_service.results.scene_scale import MetricPoses, read_scale, scale_headers
from spiked_service.results.shown_scene import ShownScene
from spiked_service.results.versions import at
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import ReconstructionRow

_ENCODED = 8
"""SPZ files, samples and changes in memory, so that each is encoded once for many viewers."""


class SceneFormat(StrEnum):
    """How a scene is written."""

    PLY = "ply"
    SPZ = "spz"


@dataclass(frozen=True)
class Result:
    """A published version and its camera."""

    folder: Path
    published: Published
    sensor: Sensor | None
    timeline: Path
    frame: FrameOfReference | None = None
    """That of the answers; None: the scene's own."""

    @property
    def scene(self) -> Path:
        """The PLY file."""
        return self.folder / self.published.scene

    def poses(self) -> PoseFile:
        """Its trajectory. Raises GoneError if the version has just been removed, SceneError."""
        own = open_poses(self.folder, self.published, self.sensor, self.timeline)
        return own if self.frame is None else MetricPoses(own.path, self.frame)

    def path(self, poses: int) -> Trajectory:
        """Its trajectory, or every n-th pose of it: `poses` of them or somewhat more. Raises as `poses` does."""
        return thinned(self.poses(), poses)

    @property
    def frame_rate_hz(self) -> float:
        """That of the camera; 1 while it is not known."""
        return 1.0 if self.sensor is None else self.sensor.frame_rate_hz

    @property
    def camera(self) -> Camera | None:
        """What it was seen with; None if its optics are not known."""
        if self.sensor is None or self.sensor.intrinsics is None:
            return None
        return Camera(self.sensor.intrinsics, self.sensor.width, self.sensor.height)

    @property
    def scale(self) -> KnownScale:
        """What is known of the scene's own unit and axes. Raises SceneError."""
        return read_scale(self.folder).known_of(self.published.version)

    @property
    def scale_of_answer(self) -> KnownScale:
        """The same of what is answered, which may be in metres. Raises SceneError."""
        return self.scale if self.frame is None else self.scale.in_metres

    @property
    def scale_headers(self) -> dict[str, str]:
        """The headers that say it. Raises SceneError."""
        return scale_headers(self.scale_of_answer)

    def metric(self) -> "Result":
        """The same in metres, with up along -y. Raises NothingError while the scale is not known."""
        frame = read_scale(self.folder).frame_of(self.published.version)
        if frame is None:
            raise NothingError("the scale of this scene is not known; PUT its scale, or give its tags to scale:tag")
        return replace(self, frame=frame)


def thinned(found: PoseFile, poses: int) -> Trajectory:
    """All poses of a file, or every n-th: `poses` of them or somewhat more."""
    return found.trajectory(range(0, len(found), max(1, len(found) // poses)))


class SceneFiles:
    """Encodes and sends scenes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._encoded: OrderedDict[tuple[object, ...], bytes] = OrderedDict()

    def response(self, request: Request, result: Result, kind: SceneFormat, max_splats: int | None) -> Response:
        """The scene of a version, or a fixed sample of `max_splats`. Raises NotReadyError, SceneError."""
        version = {"X-Scene-Version": str(result.published.version), "X-White": repr(result.published.white)}
        version |= result.scale_headers
        name = f"scene-{result.published.version:06d}.{kind}"
        if kind is SceneFormat.PLY and max_splats is None and result.frame is None:
            return files.ranged(request, result.scene, name, **version)
        stamp = files.stamp(result.scene)
        tag = files.etag(result.published.version, kind, stamp, max_splats, result.frame, result.scale)
        if files.unchanged(request, tag):
            return files.not_modified(tag)
        key = (result.scene, stamp, kind, max_splats, result.frame, result.scale)
        with self._lock:
            body = self._encoded.get(key) or _encoded(result, kind, max_splats)
            self._encoded[key] = body
            self._encoded.move_to_end(key)
            if len(self._encoded) > _ENCODED:
                self._encoded.popitem(last=False)
        return files.content(request, body, "application/octet-stream", tag, name, **version)

    def changes(self, request: Request, result: Result, since: str | None, level: int) -> Response:
        """What changed in the slots of a version since the state `since`, all of them if that is another scene's.

        Raises NotReadyError, SceneError.
        """
        version = result.published.version
        tag = files.etag("changes", result.folder.name, version, level, since or "")
        if files.unchanged(request, tag):
            return files.not_modified(tag)
        key = (result.scene, "changes", since, level)
        body = self._kept(key, lambda: _changes(result, since, level).write())
        headers = {"X-Scene-Version": str(version), "X-White": repr(result.published.white)}
        return files.content(request, body, "application/octet-stream", tag, **headers)

    def _kept(self, key: tuple[object, ...], encode: Callable[[], bytes]) -> bytes:
        """The bytes of one of the latest responses, encoded once."""
        with self._lock:
            body = self._encoded.get(key) or encode()
            self._encoded[key] = body
            self._encoded.move_to_end(key)
            if len(self._encoded) > _ENCODED:
                self._encoded.popitem(last=False)
        return body


def _changes(result: Result, since: str | None, level: int) -> SceneChanges:
    shown = _slots(result)
    began, version, known_level = (0, 0, 0) if since is None else (int(part) for part in since.split("-"))
    continues = began > 0 and (began, known_level) == (shown.began, level) and version <= shown.version
    return shown.since(version if continues else None, level)


def _slots(result: Result) -> ShownScene:
    """The slots of a version; made of its scene if it is an old one."""
    published = result.published
    if published.slots is not None:
        with suppress(SceneError):  # the disk may have lost them: they are not synchronised with it
            return ShownScene.read(result.folder / published.slots, published.slots_began, published.version)
    return ShownScene.of(Scene.read_ply(result.scene), published.white, published.version)


def _encoded(result: Result, kind: SceneFormat, max_splats: int | None) -> bytes:
    scene, white = Scene.read_ply(result.scene), result.published.white
    if result.frame is not None:
        scene = result.frame.scene(scene)
    if max_splats is not None:
        scene = scene.sample(max_splats)
    return spz.encode(scene, white) if kind is SceneFormat.SPZ else scene.ply(white, result.scale_of_answer.notes)


class Results:
    """Finds published versions, and serves their scenes and trajectories."""

    def __init__(self, rows: ReconstructionRepository, captures: Captures, trajectories: ConcurrencyLimit) -> None:
        """`trajectories` limits concurrent downloads of trajectories and bundles."""
        self._rows = rows
        self._captures = captures
        self.downloads = trajectories
        self.scenes = SceneFiles()

    def newest(self, capture_id: str) -> ReconstructionRow:
        """The newest reconstruction of a capture that has a version, else the newest one.

        Raises UnknownIdError, NotReadyError, NothingError.
        """
        capture = self._captures.get(capture_id)
        row = next(iter(self._rows.shown_of([capture_id])), None)
        if row is None and capture.row.state.acquiring and capture.row.plan.reconstruct:
            raise NotReadyError(f"the reconstruction of capture {capture_id} has not begun yet")
        if row is None:
            raise NothingError(f"capture {capture_id} has no reconstruction; POST reconstructions starts one")
        return row

    def row(self, reconstruction_id: str) -> ReconstructionRow:
        """A reconstruction. Raises UnknownIdError."""
        return self._rows.get(reconstruction_id)

    def of(self, row: ReconstructionRow, version: int | None = None) -> Result:
        """A version of a reconstruction, the newest if None. Raises NotReadyError, NothingError, GoneError."""
        folder = self._rows.folder(row.id)
        published = at(folder, version)
        if published is None and version is not None and version <= row.version:
            raise GoneError(f"version {version} of reconstruction {row.id} is not kept")
        if published is None:
            named = "" if version is None else f" {version}"
            if row.state.over:
                none = "has published nothing; :restart begins it again"
                some = f"has no version{named}; GET versions lists what it has"
                raise NothingError(f"reconstruction {row.id} is {row.state} and {some if row.version else none}")
            raise NotReadyError(f"reconstruction {row.id} has no version{named} yet; it is at stage {row.stage}")
        sensor = self._captures.get(row.capture_id).row.sensor
        if sensor is not None and published.camera is not None:
            sensor = replace(sensor, intrinsics=published.camera)
        return Result(folder, published, sensor, self._rows.timeline(row.id))

    def trajectory(
        self, request: Request, result: Result, kind: TrajectoryFormat, part: Range, path: int = 0
    ) -> Response:
        """A part of the trajectory of a version, or of another path through its scene.

        Raises GoneError, NoPoseError, NothingError, ConfigurationError, OverloadedError.
        """
        version, poses, sensor = result.published.version, result.poses, result.sensor
        if path:
            poses, sensor = self._path(result, path)
        scale = result.scale_of_answer
        return trajectory_response(request, poses(), version, sensor, kind, part, self.downloads, scale)

    def poses_along(self, result: Result, path: int) -> PoseFile:
        """The poses of another recording in the map of a version. Raises NothingError, SceneError."""
        return self._path(result, path)[0]()

    def _path(self, result: Result, path: int) -> tuple[Callable[[], PoseFile], Sensor | None]:
        """The poses of another recording in the map of a version, and its sensor."""
        others = result.published.paths
        if path > len(others):
            raise NothingError(f"version {result.published.version} has no path {path}; GET paths lists what it has")
        other = others[path - 1]
        try:
            sensor = self._captures.get(other.capture_id).row.sensor
        except UnknownIdError:  # it was removed, but not its path
            rate_hz = other.frame_rate_hz
            sensor = result.sensor and replace(result.sensor, frame_rate_hz=rate_hz, intrinsics=None)
        name, frame = result.folder / other.trajectory, result.frame
        return (lambda: PoseFile(name) if frame is None else MetricPoses(name, frame)), sensor
