"""Depth, normals and colours of a scene from a pose.

The expected depth is the mean z of what a pixel shows, weighted as its colour is: between an edge and what lies behind
it lies in the air. The median depth is the mean z of those splats alone that lie around the one in which half of the
light is stopped: depths are sorted into bins, each pixel takes the bin of its median and both neighbours.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.export.source import ExportOptions, ExportSource, camera_of
from spiked.render import AnyRasteriser, Camera, rasteriser_for
from spiked.scene import Scene

__all__ = ["RenderedView", "rendered_views"]

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

BINS = 48
"""Bins of depth: a splat is in a bin with as many others as in any other, of those that the camera can see."""
OPAQUE = 0.5
"""Opacity of a pixel that has a depth, at least."""
NORMAL_PX, NORMAL_NOISE = 3.0, 0.02
"""Normals are those of depths smoothed by a bilateral filter of this width, which keeps edges of relative depths beyond
the noise: a pixel of 400x250 in a room is one hundredth of the depth wide, as far as depths scatter."""
STEEPEST = 0.1
"""Difference of the depths of neighbouring pixels, relative to the depth, beyond which there is no surface between."""


@dataclass(frozen=True)
class RenderedView:
    """What the scene shows from a pose of the path; [H, W] images of a camera."""

    row: int
    """Of the path: of its pose, or of the one nearest in time."""
    time_s: float
    camera: Camera
    rotation: Doubles
    """Camera to world, [3, 3]."""
    centre: Doubles
    colour: Floats
    """Radiance, [H, W] or [H, W, 3]."""
    depth: Floats
    """z along the camera's axis in the scene's unit of length; 0 where there is no surface."""

    def rays(self) -> Doubles:
        """Directions with z = 1 of the pixels, in camera axes, [H, W, 3]."""
        return pixel_rays(self.camera)

    def points(self) -> Doubles:
        """World positions of the pixels, [H, W, 3]; meaningless where there is no depth."""
        return (self.rays() * self.depth[..., None]) @ self.rotation.T + self.centre

    def normals(self) -> Floats:
        """Unit normals in camera axes, towards the camera, [H, W, 3]; 0 beside edges and where there is no depth."""
        at = self.rays() * _smoothed(self.depth)[..., None]
        right, down = np.roll(at, -1, 1) - np.roll(at, 1, 1), np.roll(at, -1, 0) - np.roll(at, 1, 0)
        normal = np.cross(down, right)
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
        flat = _flat(self.depth)
        return np.asarray(np.where(flat[..., None], normal, 0), np.float32)

    def sampled_depth(self, pixels: Doubles) -> Doubles:
        """Depth [n] at pixels [n, 2], of the nearest pixel; 0 outside."""
        x, y = np.floor(pixels).astype(np.int64).T
        inside = (x >= 0) & (y >= 0) & (x < self.camera.width) & (y < self.camera.height)
        found = np.zeros(len(pixels))
        found[inside] = self.depth[y[inside], x[inside]]
        return found

    def in_camera(self, points: Doubles) -> Doubles:
        """World points [n, 3] in camera axes."""
        return np.asarray((points - self.centre) @ self.rotation)


def pixel_rays(camera: Camera) -> Doubles:
    """Directions with z = 1 of the pixels, in camera axes, [H, W, 3]."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    return camera.intrinsics.unproject(np.stack([x, y], -1))


def rendered_views(source: ExportSource, options: ExportOptions) -> Iterator[RenderedView]:
    """The key views of a reconstruction, one after the other. Raises SceneError and ConfigurationError."""
    scene, camera = source.need_scene(), camera_of(source.seen_by(options))
    rasteriser = rasteriser_for(camera)
    for pose in source.key_poses(options):
        colour, depth = rendered(rasteriser, scene, pose.rotation, pose.centre, options.depth)
        yield RenderedView(pose.row, pose.time_s, camera, pose.rotation, pose.centre, colour, depth)


def rendered(
    rasteriser: AnyRasteriser, scene: Scene, rotation: Doubles, centre: Doubles, kind: Literal["median", "expected"]
) -> tuple[Floats, Floats]:
    """Radiance and depth from a pose; depth is 0 where the scene is less opaque than `OPAQUE`."""
    scene = scene.seen_from(centre)
    image = rasteriser.forward(scene, rotation[None], centre[None])
    depth = image.depth if kind == "expected" else _median(rasteriser, scene, rotation, centre)
    return image.values, np.where(image.alpha >= OPAQUE, depth, 0).astype(np.float32)


def _median(rasteriser: AnyRasteriser, scene: Scene, rotation: Doubles, centre: Doubles) -> Floats:
    z = ((scene.means - centre) @ rotation[:, 2]).astype(np.float32)
    front = np.sort(z[z > 0])
    edges = front[np.linspace(0, len(front) - 1, BINS + 1).astype(int)[1:-1]] if len(front) else np.zeros(BINS - 1)
    bins = np.searchsorted(edges, z)
    pose = rotation[None], centre[None]

    def sums(values: Floats) -> Floats:
        """Sum of the values of a bin over its share of each pixel, [H, W, BINS]."""
        parts = []
        for first in range(0, BINS, 3):
            one = np.where(bins[:, None] == np.arange(first, first + 3), values[:, None], 0).astype(np.float32)
            parts.append(rasteriser.forward(replace(scene, colours=np.ascontiguousarray(one)), *pose).values)
        return np.concatenate(parts, -1)

    shares, moments = sums(np.ones(len(z), np.float32)), sums(z)
    middle = (np.cumsum(shares, -1) < 0.5 * shares.sum(-1, keepdims=True)).sum(-1).clip(0, BINS - 1)
    near = np.abs(np.arange(BINS) - middle[..., None]) <= 1
    return np.asarray((moments * near).sum(-1) / np.maximum((shares * near).sum(-1), 1e-6), np.float32)


def _smoothed(depth: Floats) -> Floats:
    """Depth [H, W] without its noise, edges kept: by logarithms, so that the noise is relative to the depth."""
    logs = np.log(np.maximum(depth, 1e-6))
    smooth = cv2.bilateralFilter(logs, -1, NORMAL_NOISE, NORMAL_PX)
    return np.asarray(np.where(depth > 0, np.exp(smooth), 0), np.float32)


def _flat(depth: Floats) -> NDArray[np.bool_]:
    """Where a pixel and its neighbours are of one surface."""
    kernel = np.ones((3, 3), np.uint8)
    high, low = cv2.dilate(depth, kernel), cv2.erode(depth, kernel)
    flat = (low > 0) & (high - low < STEEPEST * depth)
    flat[[0, -1]] = False
    flat[:, [0, -1]] = False
    return np.asarray(flat)
