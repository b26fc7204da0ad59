"""A simulated camera: scene, path and sensor; an endless stream of frames with ground truth."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import Image, Intrinsics, Sensor
from spiked.simulate.exposure import Exposure
from spiked.simulate.motion import Motion, MotionKind, make_motion
from spiked.simulate.room import Room
from spiked.simulate.sensor import Lighting, PixelMaps, SensorNoise, SpikeSensor
from spiked.simulate.spans import (
    InterpolationError,
    PathRadiance,
    grouped_spans,
    interpolation_error,
    spaced_spans,
)
from spiked.simulate.view import ViewableScene

Array = NDArray[np.float64]

DEFAULT_GAIN = 0.35
"""Spikes a frame of white, where the scene does not say it."""

DEFAULT_FOV_DEG = 60.0
"""Horizontal field of view of a simulated camera whose sensor states no intrinsics."""

LONG_FRAMES = 20_480
"""Recordings of more frames are interpolated between exact pictures `LONG_STEP_PX` apart."""

LONG_STEP_PX = 0.3
"""Image motion between exact pictures of long recordings: off by 0.1 to 0.2 % of white RMS, see decision 14."""


def default_step_px(frames: int) -> float | None:
    """`step_px` of a recording of `frames` frames, where the user does not say it."""
    return LONG_STEP_PX if frames > LONG_FRAMES else None


class SimulatedCamera:
    """A camera that moves through a scene for ever; the same arguments give the same bits, in calls of any size."""

    def __init__(
        self,
        sensor: Sensor,
        seed: int = 0,
        motion: Motion | MotionKind = MotionKind.HAND_SHAKE,
        scene: ViewableScene | None = None,
        noise: SensorNoise | None = None,
        *,
        gain: float = DEFAULT_GAIN,
        flow_px: float = 0.12,
        parallax: float = 0.1,
        lighting: Lighting | None = None,
        maps: PixelMaps | None = None,
        step_px: float | None = None,
        threads: int = 1,
    ) -> None:
        """A camera with its sensor, path and scene.

        sensor: geometry and storage; without intrinsics it gets a field of view of 60 degrees.
        seed: of the noise, of the path and, for the built-in room, of what is painted in it.
        motion: a path in the scene's coordinates, or a kind of path through the built-in room.
        scene: the scene; the built-in room if None.
        gain: expected spikes a frame of intensity 1.
        flow_px, parallax: speed of a path given by kind, see `Stage`.
        step_px: image motion between exact pictures, see `spaced_spans`; None: at least one every 8 frames, see
            `grouped_spans`.
        threads: used for drawing the room and exposing the sensor; changes nothing but the speed.
        Raises ConfigurationError for a kind of path without the built-in room, or a gain or step that is not positive.
        """
        if step_px is not None and not step_px > 0:
            raise ConfigurationError(f"a step of {step_px:g} px between exact pictures must be positive")
        if not gain > 0:
            raise ConfigurationError(f"gain {gain:g} must be a positive number of spikes a frame")
        self.intrinsics = sensor.intrinsics or Intrinsics.from_fov(sensor.width, sensor.height, DEFAULT_FOV_DEG)
        self.sensor = sensor
        self.gain = gain
        if isinstance(motion, MotionKind):
            if scene is not None:
                raise ConfigurationError("a scene of your own needs a path in its coordinates, not a kind of motion")
            room = Room(sensor.mosaic is not None, seed, threads=threads)
            self.motion = make_motion(motion, room.stage(self.intrinsics, flow_px, parallax), seed)
            self.scene: ViewableScene = room
        else:
            self.scene = scene or Room(sensor.mosaic is not None, seed, threads=threads)
            self.motion = motion
        self.spikes = SpikeSensor(sensor, seed, noise or SensorNoise(), lighting or Lighting(), maps, threads=threads)
        self.step_px = step_px
        self._radiance = self.path_radiance()
        depth = self._radiance.nearest_depth()
        spans = grouped_spans(self._radiance, depth) if step_px is None else spaced_spans(self._radiance, step_px)
        self._exposure = Exposure(self.spikes, spans)

    def path_radiance(self) -> PathRadiance:
        """What the sensor sees along the path; a subclass may put something in front of it. Called once."""
        return PathRadiance(self.scene, self.motion, self.sensor, self.intrinsics, self.gain)

    def next_frames(self, count: int) -> NDArray[np.uint8]:
        """The next frames as stored, uint8 [count, frame_bytes]."""
        return self._exposure.next_frames(count)

    def truth(self, frames: ArrayLike) -> tuple[Array, Array]:
        """Camera-to-world rotations [n, 3, 3] and centres [n, 3] at the middle of each frame [n]."""
        return self.motion.poses(np.atleast_1d(np.asarray(frames, np.float64)) + 0.5)

    def view(self, rotation: Array, centre: Array, undistorted: bool = False) -> Image:
        """Noise-free radiance in expected spikes a frame, without the dark: [H, W], on a mosaic sensor [H, W, 3].

        `undistorted`: as `intrinsics.pinhole` sees it.
        """
        intensity = self._radiance.intensity(self._radiance.view(rotation, centre, undistorted))
        return np.asarray(self.gain * intensity, np.float32)

    def depth(self, rotation: Array, centre: Array, undistorted: bool = False) -> Image:
        """The exact depth [H, W] of the same picture, in the scene's length unit."""
        return self._radiance.view(rotation, centre, undistorted).depth

    def interpolation_error(self, frames: int) -> InterpolationError | None:
        """Error of the interpolation over the first `frames` frames, measured; None if `step_px` is None."""
        return None if self.step_px is None else interpolation_error(self._radiance, self.step_px, frames)
