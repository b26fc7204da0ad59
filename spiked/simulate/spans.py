"""Runs of frames that share two exact pictures: what a sensor sees along a path, at the cost of few renders."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import Image, Intrinsics, Sensor
from spiked.simulate.lens import LensedScene
from spiked.simulate.motion import Motion
from spiked.simulate.view import LUMINANCE, View, ViewableScene

Array = NDArray[np.float64]

_GROUP = 8
"""Frames of the longest span in `grouped_spans`."""
_GROUP_STEP_PX = 0.6
"""Largest image motion between the pictures of a span in `grouped_spans`; halfway, a detail of four pixels from crest
to crest loses 11 % of its contrast."""

_LONGEST = 512
"""Frames of a span in `spaced_spans`; bounds memory and the search for its end."""


@dataclass(frozen=True)
class Span:
    """Consecutive frames whose radiance runs linearly between two images."""

    first: Image
    last: Image
    weights: Image
    """Weight of `last` in the mean radiance of each frame, float32 [n]."""


@dataclass(frozen=True)
class PathRadiance:
    """The radiance on each site of a sensor at any moment of a path through a scene."""

    scene: ViewableScene
    motion: Motion
    sensor: Sensor
    intrinsics: Intrinsics
    gain: float
    """Expected spikes a frame of intensity 1."""

    @cached_property
    def _sites(self) -> NDArray[np.int64] | None:
        """The colour that each site of a mosaic sees [H, W, 1]."""
        mosaic = self.sensor.mosaic
        if mosaic is None:
            return None
        return mosaic.channels(self.sensor.height, self.sensor.width)[..., None].astype(np.int64)

    def view(self, rotation: Array, centre: Array, undistorted: bool = False) -> View:
        """The scene's picture at a camera-to-world pose; `undistorted`: without the distortion of the lens."""
        intrinsics = self.intrinsics.pinhole if undistorted else self.intrinsics
        return self._lensed.render(intrinsics, self.sensor.width, self.sensor.height, rotation, centre)

    @cached_property
    def _lensed(self) -> LensedScene:
        return LensedScene(self.scene)

    def intensity(self, view: View) -> Image:
        """Its grey [H, W], on a mosaic sensor its colours [H, W, 3]."""
        intensity = view.intensity
        if self.sensor.mosaic is not None:
            return intensity if intensity.shape[2] == 3 else np.repeat(intensity, 3, 2)
        return intensity[..., 0] if intensity.shape[2] == 1 else intensity @ LUMINANCE

    def at(self, frame: float) -> Image:
        """Expected spikes a frame [H, W] at a moment in frames."""
        return self.at_with_depth(frame)[0]

    def at_with_depth(self, frame: float) -> tuple[Image, Image]:
        """`at` and the depth [H, W]."""
        rotations, centres = self.motion.poses(np.array([frame]))
        view = self.view(rotations[0], centres[0])
        intensity = self.intensity(view)
        if self._sites is not None:
            intensity = np.take_along_axis(intensity, self._sites, 2)[..., 0]
        return np.ascontiguousarray(self.gain * intensity, np.float32), view.depth

    def nearest_depth(self) -> float:
        """The depth that is nearer than 95 % of the first picture. Raises ConfigurationError if it is empty."""
        depth = nearest_depth(self.at_with_depth(0)[1])
        if not np.isfinite(depth):
            raise ConfigurationError("the camera's path starts with nothing in sight; check the path and the scene")
        return depth

    def steps_px(self, times: Array, depth: float) -> Array:
        """Image motion of points at `depth` between consecutive times, an upper estimate in pixels [n - 1]."""
        rotations, centres = self.motion.poses(times)
        trace = np.einsum("nij,nij->n", rotations[:-1], rotations[1:])
        angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        shift = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        return np.asarray(self.intrinsics.fx * (angle + shift / depth))

    def blurred(self, frame: int, parts: int) -> Span:
        """One frame that moves far: the mean of the images at the middles of `parts` equal parts."""
        total = self.at(frame + 0.5 / parts)
        for part in range(1, parts):
            total = total + self.at(frame + (part + 0.5) / parts)
        mean = np.asarray(total / np.float32(parts), np.float32)
        return Span(mean, mean, np.zeros(1, np.float32))


def nearest_depth(depth: Image) -> float:
    """The 5th percentile of the finite positive depths; infinite if there are none."""
    finite = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.percentile(finite, 5)) if len(finite) else np.inf


def grouped_spans(radiance: PathRadiance, depth: float) -> Iterator[Span]:
    """Groups of eight frames, each cut so that the images at the ends of a span lie at most 0.6 px apart.

    depth: at which motion is computed, over the whole path.
    How a group is cut depends on the path alone, so the number of frames that are asked for at a time changes nothing.
    """
    group, at, image = 0, 0, radiance.at(0)
    while True:
        steps = radiance.steps_px(np.arange(group, group + _GROUP + 1, dtype=np.float64), depth)
        if steps.max() > _GROUP_STEP_PX:
            for k in range(_GROUP):
                yield radiance.blurred(group + k, _parts(steps[k], _GROUP_STEP_PX))
        else:
            frames = _GROUP
            while frames > 1 and max(np.add.reduceat(steps, np.arange(0, _GROUP, frames))) > _GROUP_STEP_PX:
                frames //= 2
            for begin in range(group, group + _GROUP, frames):
                if at != begin:
                    image = radiance.at(begin)
                at = begin + frames
                following = image if steps.max() == 0 else radiance.at(at)
                yield _linear(image, following, frames)
                image = following
        group += _GROUP


def spaced_spans(radiance: PathRadiance, step_px: float, start: int = 0) -> Iterator[Span]:
    """Spans as long as their image motion stays within `step_px`, from frame `start` on; at most 512 frames.

    Motion is computed at the nearest depth of the picture that begins a span. A frame that moves farther is the mean of
    images at most `step_px` apart.
    """
    image, depth = radiance.at_with_depth(start)
    frame = start
    while True:
        # A sixteenth of the pixels give the percentile well enough.
        near = nearest_depth(depth[::4, ::4])
        steps = radiance.steps_px(np.arange(frame, frame + _LONGEST + 1, dtype=np.float64), near)
        frames = max(int(np.searchsorted(np.cumsum(steps), step_px, "right")), 1)
        following, depth = radiance.at_with_depth(frame + frames) if steps[:frames].any() else (image, depth)
        if steps[0] > step_px:
            yield radiance.blurred(frame, _parts(steps[0], step_px))
        else:
            yield _linear(image, following, frames)
        image = following
        frame += frames


def _parts(motion_px: float, step_px: float) -> int:
    return max(int(np.ceil(motion_px / step_px)), 1)


def _linear(first: Image, last: Image, frames: int) -> Span:
    return Span(first, last, ((np.arange(frames) + 0.5) / frames).astype(np.float32))


@dataclass(frozen=True)
class InterpolationError:
    """Difference of interpolated and exact radiance halfway between two exact pictures, where it is largest."""

    step_px: float
    """Image motion between the exact pictures."""
    samples: int
    """Spans that were measured, evenly spread over the path."""
    rms_percent: float
    """Root mean square over all pixels, in percent of white."""
    worst_rms_percent: float
    """The same over the pixels of the worst sample."""
    max_percent: float
    """Largest difference of a pixel, in percent of white."""


def interpolation_error(radiance: PathRadiance, step_px: float, frames: int, samples: int = 32) -> InterpolationError:
    """Measure the error of `spaced_spans` in `samples` spans along the first `frames` frames.

    Each sample costs three renders. Frames that are means of images are not interpolated and do not count.
    """
    squares, largest = [], 0.0
    for start in np.linspace(0, frames, samples, endpoint=False).astype(int):
        span = next(spaced_spans(radiance, step_px, int(start)))
        middle = len(span.weights) // 2
        weight = span.weights[middle]
        if weight == 0:
            continue
        error = span.first + weight * (span.last - span.first) - radiance.at(start + middle + 0.5)
        squares.append(float(np.square(error, dtype=np.float64).mean()))
        largest = max(largest, float(np.abs(error).max()))
    percent = 100 / radiance.gain
    mean, worst = (np.mean(squares), max(squares)) if squares else (0.0, 0.0)
    return InterpolationError(
        step_px, len(squares), percent * float(np.sqrt(mean)), percent * float(np.sqrt(worst)), percent * largest
    )
