"""What an export is made of: a reconstruction, its camera, and the recording if it is at hand."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, SceneError
from spiked.frame_of_reference import FrameOfReference, KnownScale
from spiked.pose import exp_so3, log_so3
from spiked.recon.statistics import evenly
from spiked.recording import Recording
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import BRIDGED_S, Trajectory

__all__ = ["ExportOptions", "ExportSource"]

Array = NDArray[np.float64]
SAME_S = 1e-7
"""Times closer than this are the same: files have nanoseconds."""
KEY_VIEWS = 40
"""Views of an export unless their number is chosen: neighbours overlap by more than half on a path across a room."""


@dataclass(frozen=True)
class ExportOptions:
    """How an export is made. Formats that have no use for an option ignore it."""

    views: int = KEY_VIEWS
    """Poses that depth maps, pictures, points and meshes are made from, evenly spaced along the path."""
    undistorted: bool = False
    """Pictures, depth maps and cameras without the distortion of the lens, with the same focal length and size."""
    depth: Literal["median", "expected"] = "median"
    """Depth of a pixel: see `spiked.export.views`."""
    resolution: int = 256
    """Voxels along the longest side of the volume that a mesh is made in; points are at least half a voxel apart."""
    seconds: float = 10.0
    """Length of a video."""
    pictures_a_second: float = 30.0
    """Of a video."""
    width: int | None = None
    """Of a video, pixels; None: that of the sensor."""
    height: int | None = None
    """Of a video, pixels; None: by the width, in the shape of the sensor."""
    along: Literal["smooth", "recorded"] = "smooth"
    """Whether a video goes along the recorded path without its tremor, or as it is."""
    through: tuple[tuple[float, ...], ...] = ()
    """Poses that a video goes through, in the scene's own unit: centre x, y, z and rotation w, x, y, z of each. None:
    it goes `along` the recorded path."""
    frames: tuple[int, ...] = ()
    """Frames of the capture that the key views are of, in place of `views`; between poses the path is interpolated."""


@dataclass(frozen=True)
class KeyPose:
    """Where a key view is taken from."""

    row: int
    """Of the path: the pose, or the one nearest in time."""
    time_s: float
    rotation: Array
    """Camera to world, [3, 3]."""
    centre: Array


@dataclass(frozen=True)
class ExportSource:
    """A reconstruction."""

    path: Trajectory
    """Camera-to-world poses, times in seconds since frame 0 of the capture."""
    sensor: Sensor | None
    """With the optics that the reconstruction found or was given."""
    scene: Scene | None = None
    recording: Recording | None = None
    first_frame: int = 0
    """Index in the capture of the recording's first frame."""
    name: str = "spiked"
    """Of files."""
    title: str = ""
    """For people, if it has another one."""
    scale: KnownScale = field(default_factory=KnownScale)
    """What is known of the unit of lengths and the axes."""

    @property
    def unit(self) -> str:
        """Of lengths: `m` once it is in metres."""
        return self.scale.unit

    @classmethod
    def of_splats(cls, scene: Scene, name: str) -> "ExportSource":
        """A scene without a path and a camera."""
        return cls(Trajectory.empty(), None, scene, name=name)

    def in_frame(self, frame: FrameOfReference) -> "ExportSource":
        """The same in metres and upright axes."""
        scene = None if self.scene is None else frame.scene(self.scene)
        return replace(self, path=frame.trajectory(self.path), scene=scene, scale=self.scale.in_metres)

    def need_scene(self) -> Scene:
        """Raises SceneError without splats."""
        if self.scene is None or not len(self.scene):
            raise SceneError(f"{self.name} has no splats, and this format is made of them; reconstruct a scene first")
        return self.scene

    def need_sensor(self) -> Sensor:
        """Raises ConfigurationError without a sensor whose optics are known."""
        if self.sensor is None or self.sensor.intrinsics is None:
            raise ConfigurationError(
                f"the optics of {self.name} are not known, and this format needs them; name its recording"
            )
        return self.sensor

    def need_recording(self) -> Recording:
        """Raises ConfigurationError without a recording."""
        if self.recording is None:
            raise ConfigurationError(
                f"this format has pictures of the recording of {self.name}; name it with --recording FILE"
            )
        return self.recording

    def need_path(self) -> Trajectory:
        """Raises SceneError without poses."""
        if not len(self.path):
            raise SceneError(f"{self.name} has no poses, and this format needs them")
        return self.path

    def seen_by(self, options: ExportOptions) -> Sensor:
        """The sensor of the exported pictures: without distortion if that is asked for."""
        sensor = self.need_sensor()
        if not options.undistorted or sensor.intrinsics is None:
            return sensor
        return replace(sensor, intrinsics=sensor.intrinsics.pinhole)

    def key_rows(self, options: ExportOptions) -> list[int]:
        """Rows of the path that the views are taken at."""
        return evenly(len(self.need_path()), options.views)

    def key_poses(self, options: ExportOptions) -> list[KeyPose]:
        """The poses of the key views. Raises SceneError for a frame without one, and ConfigurationError."""
        path = self.need_path()
        if not options.frames:
            rows = self.key_rows(options)
            return [KeyPose(row, float(path.times_s[row]), path.rotations[row], path.centres[row]) for row in rows]
        rate = self.need_sensor().frame_rate_hz
        return [self._pose_at(frame, (frame + 0.5) / rate) for frame in sorted(set(options.frames))]

    def _pose_at(self, frame: int, time_s: float) -> KeyPose:
        path = self.path
        row = int(np.abs(path.times_s - time_s).argmin())
        if abs(path.times_s[row] - time_s) < SAME_S:
            return KeyPose(row, float(path.times_s[row]), path.rotations[row], path.centres[row])
        after = int(np.searchsorted(path.times_s, time_s))
        if not 0 < after < len(path) or path.times_s[after] - path.times_s[after - 1] > BRIDGED_S:
            raise self._no_pose(frame, after)
        begin, end = path.times_s[after - 1 : after + 1]
        share = (time_s - begin) / (end - begin)
        before = path.rotations[after - 1]
        turn = exp_so3(share * log_so3(before.T @ path.rotations[after]))
        centre = (1 - share) * path.centres[after - 1] + share * path.centres[after]
        return KeyPose(row, time_s, before @ turn, centre)

    def _no_pose(self, frame: int, after: int) -> SceneError:
        """Of a frame before this row of the path, which has none."""
        inside, rate = 0 < after < len(self.path), self.need_sensor().frame_rate_hz
        rows = (after - 1, after) if inside else (0, -1)
        first, last = (round(float(self.path.times_s[row]) * rate - 0.5) for row in rows)
        known = f"there are none between {first} and {last}" if inside else f"there are poses from {first} to {last}"
        return SceneError(f"frame {frame} of {self.name} has no pose; {known}")

    @cached_property
    def white(self) -> float:
        """Radiance that is shown as white."""
        return 1.0 if self.scene is None else self.scene.colour_of_white


def camera_of(sensor: Sensor) -> Camera:
    """The camera of a sensor whose optics are known."""
    assert sensor.intrinsics is not None
    return Camera(sensor.intrinsics, sensor.width, sensor.height)


def optics_of(sensor: Sensor) -> Intrinsics:
    """The optics of a sensor whose optics are known."""
    assert sensor.intrinsics is not None
    return sensor.intrinsics
