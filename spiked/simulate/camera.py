"""A simulated camera: a scene, a path and a sensor together; frames for ever, and the truth about them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate.motion import Motion, MotionKind, make_motion
from spiked.simulate.room import Room
from spiked.simulate.sensor import Lighting, PixelMaps, SensorNoise, SpikeSensor
from spiked.simulate.view import LUMINANCE, View, ViewableScene

Array = NDArray[np.float64]
Image = NDArray[np.float32]

DEFAULT_FOV_DEG = 60.0
"""Horizontal field of view of a simulated camera whose sensor states no intrinsics."""

_GROUP = 8
_STEP_PX = 0.6
"""Images are exact at least every so many pixels of motion and run linearly in between; halfway, a detail of four
pixels from crest to crest loses 11 % of its contrast."""


@dataclass(frozen=True)
class _Span:
    """Frames that share their two images."""

    first: Image
    last: Image
    weights: Image


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
        gain: float = 0.35,
        flow_px: float = 0.12,
        parallax: float = 0.1,
        lighting: Lighting | None = None,
        maps: PixelMaps | None = None,
        threads: int = 1,
    ) -> None:
        """A camera with its sensor, path and scene.

        sensor: geometry and storage; without intrinsics it gets a field of view of 60 degrees.
        seed: of the noise, of the path and, for the built-in room, of what is painted in it.
        motion: a path in the scene's coordinates, or a kind of path through the built-in room.
        scene: what to look at; the built-in room if None.
        gain: expected spikes a frame of intensity 1.
        flow_px, parallax: speed of a path given by kind, see `Stage`.
        threads: used for drawing the room and exposing the sensor; changes nothing but the speed.
        Raises ConfigurationError for a kind of path without the built-in room, or a gain that is not positive.
        """
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
        channels = sensor.mosaic.channels(sensor.height, sensor.width) if sensor.mosaic else None
        self._sites = None if channels is None else channels[..., None].astype(np.int64)
        self._near = self._nearest_depth()
        self._spans: Iterator[_Span] = self._all_spans()
        self._left: _Span | None = None

    def next_frames(self, count: int) -> NDArray[np.uint8]:
        """The next frames as stored, uint8 [count, frame_bytes]."""
        out = np.empty((count, self.sensor.frame_bytes), np.uint8)
        done = 0
        while done < count:
            span = self._left or next(self._spans)
            take = min(count - done, len(span.weights))
            self.spikes.expose(span.first, span.last, span.weights[:take], out[done : done + take])
            rest = span.weights[take:]
            self._left = _Span(span.first, span.last, rest) if len(rest) else None
            done += take
        return out

    def truth(self, frames: ArrayLike) -> tuple[Array, Array]:
        """Camera-to-world rotations [n, 3, 3] and centres [n, 3] at the middle of each frame [n]."""
        return self.motion.poses(np.atleast_1d(np.asarray(frames, np.float64)) + 0.5)

    def view(self, rotation: Array, centre: Array) -> Image:
        """Noise-free radiance in expected spikes a frame, without the dark: [H, W], on a mosaic sensor [H, W, 3]."""
        intensity = self._intensity(rotation, centre)
        return np.asarray(self.gain * intensity, np.float32)

    def depth(self, rotation: Array, centre: Array) -> Image:
        """The exact depth [H, W] of the same picture, in the scene's length unit."""
        return self._look(rotation, centre).depth

    def _look(self, rotation: Array, centre: Array) -> View:
        return self.scene.look(self.intrinsics, self.sensor.width, self.sensor.height, rotation, centre)

    def _intensity(self, rotation: Array, centre: Array) -> Image:
        intensity = self._look(rotation, centre).intensity
        if self._sites is not None:
            return intensity if intensity.shape[2] == 3 else np.repeat(intensity, 3, 2)
        return intensity[..., 0] if intensity.shape[2] == 1 else intensity @ LUMINANCE

    def _seen(self, frame: float) -> Image:
        """What each site of the sensor sees at a moment, in spikes a frame [H, W]."""
        rotations, centres = self.motion.poses(np.array([frame]))
        intensity = self._intensity(rotations[0], centres[0])
        if self._sites is not None:
            intensity = np.take_along_axis(intensity, self._sites, 2)[..., 0]
        return np.ascontiguousarray(self.gain * intensity, np.float32)

    def _nearest_depth(self) -> float:
        """The depth that motion is judged at: nearer than 95 % of the first picture."""
        rotations, centres = self.motion.poses(np.zeros(1))
        depth = self._look(rotations[0], centres[0]).depth
        finite = depth[np.isfinite(depth) & (depth > 0)]
        if not len(finite):
            raise ConfigurationError("the camera's path starts with nothing in sight; check the path and the scene")
        return float(np.percentile(finite, 5))

    def _steps_px(self, times: Array) -> Array:
        """Image motion between consecutive times, an upper estimate in pixels [n - 1]."""
        rotations, centres = self.motion.poses(times)
        trace = np.einsum("nij,nij->n", rotations[:-1], rotations[1:])
        angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        shift = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        return np.asarray(self.intrinsics.fx * (angle + shift / self._near))

    def _all_spans(self) -> Iterator[_Span]:
        """Groups of eight frames, each cut so that the images at the ends of a span lie at most `_STEP_PX` apart.

        How a group is cut depends on the path alone, so neither the bits nor the images depend on the calls.
        """
        group, at, image = 0, 0, self._seen(0)
        while True:
            steps = self._steps_px(np.arange(group, group + _GROUP + 1, dtype=np.float64))
            if steps.max() > _STEP_PX:
                for k in range(_GROUP):
                    yield self._blurred(group + k, steps[k])
            else:
                frames = _GROUP
                while frames > 1 and max(np.add.reduceat(steps, np.arange(0, _GROUP, frames))) > _STEP_PX:
                    frames //= 2
                for begin in range(group, group + _GROUP, frames):
                    if at != begin:
                        image = self._seen(begin)
                    at = begin + frames
                    following = image if steps.max() == 0 else self._seen(at)
                    yield _Span(image, following, ((np.arange(frames) + 0.5) / frames).astype(np.float32))
                    image = following
            group += _GROUP

    def _blurred(self, frame: int, step_px: float) -> _Span:
        """One frame that moves far: the mean of images at the middles of parts that move at most `_STEP_PX`."""
        parts = max(int(np.ceil(step_px / _STEP_PX)), 1)
        total = self._seen(frame + 0.5 / parts)
        for part in range(1, parts):
            total = total + self._seen(frame + (part + 0.5) / parts)
        mean = np.asarray(total / np.float32(parts), np.float32)
        return _Span(mean, mean, np.zeros(1, np.float32))
