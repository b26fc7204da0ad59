"""The CPU rasteriser: one Python face for the kernels of `spiked/native/raster`."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.errors import ConfigurationError
from spiked.native._raster import Renderer
from spiked.render.camera import Camera
from spiked.render.splats import AnySplats, DeviceScene, Floats, Gradients, RenderedImage
from spiked.scene import Scene

MAX_THREADS = 256
"""Most threads of a rasteriser."""


def usable_cores() -> int:
    """The number of cores that this process may run on, of which a rasteriser can use `MAX_THREADS`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MAX_THREADS)


class Rasteriser:
    """Renders splats from one or more sub-poses, and the gradients of the last image.

    The image is the weighted sum over sub-poses of alpha-composited elliptical Gaussians (EWA splatting as in 3DGS,
    with gsplat's constants): pixel centres at +0.5, 0.3 px^2 added to the projected covariance, alpha at most 0.99,
    nothing below 1/255, the Jacobian taken at x/z and y/z clamped to 1.3 times the half field of view. A block of 4x4
    pixels is finished when none of them lets 1e-4 of the light through. Through a lens with distortion, means and
    Jacobian are those of the bent image. The number of threads changes no bit.

    One object serves one thread at a time, and does not survive a fork. SPIKED_SIMD (avx512, avx2, baseline) forces an
    instruction set, for tests and comparisons.
    """

    def __init__(self, camera: Camera, threads: int | None = None, near: float = 0.01) -> None:
        """Threads default to the cores this process may use; splats with z below near (scene units) are not drawn."""
        threads = usable_cores() if threads is None else threads
        if not 1 <= threads <= MAX_THREADS:
            raise ConfigurationError(f"cannot render with {threads} threads: use 1 to {MAX_THREADS}")
        if not near > 0:
            raise ConfigurationError(f"the near plane is at {near:g}: it must be positive")
        self.camera = camera
        k = camera.intrinsics
        optics = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "width": camera.width, "height": camera.height}
        try:
            self._native = self._renderer(near, threads, **optics, **k.lens())
        except ValueError as error:
            raise ConfigurationError(str(error)) from error
        self._inputs: tuple[object, ...] | None = None
        self._shapes: tuple[int, int, int] = (0, 0, 0)
        self._values_shape: tuple[int, ...] = ()

    def _splats(self, splats: AnySplats) -> tuple[tuple[Any, ...], int, int]:
        """What the renderer takes of a scene, and the numbers of its splats and colours."""
        if isinstance(splats, DeviceScene):
            raise ConfigurationError("the splats are on a GPU, and this rasteriser is the CPU's")
        arrays = _checked_splats(splats)
        return arrays, *arrays[4].shape

    def _check_slope(self, d_values: Floats) -> None:
        if self._inputs is None:
            raise ConfigurationError("backward() differentiates the last forward(), and there was none")
        if d_values.shape != self._values_shape:
            raise ConfigurationError(f"d_values is {d_values.shape}, expected {self._values_shape} as rendered")

    def _renderer(self, near: float, threads: int, **optics: Any) -> Any:
        """What does the work."""
        return Renderer(near=near, threads=threads, **optics)

    @property
    def instructions(self) -> str:
        """The instruction set in use: avx512, avx2 or baseline."""
        return str(self._native.instructions)

    @property
    def block_evaluations(self) -> int:
        """Pairs of a splat and a block of 4x4 pixels that it reaches in the last forward(), over all sub-poses."""
        return int(self._native.block_evaluations)

    def forward(
        self,
        splats: AnySplats,
        rotations: ArrayLike,
        centres: ArrayLike,
        *,
        weights: Floats | None = None,
        channels: NDArray[np.uint8] | None = None,
        background: float | Sequence[float] = 0.0,
    ) -> RenderedImage:
        """Render sum_s weights_s C_s.

        rotations [S, 3, 3] camera to world and centres [S, 3] are the S sub-poses. weights [S, H, W], float32, not
        negative, default to 1/S each. With channels [H, W] of 0, 1, 2 (`Mosaic.channels`) and splats of three colours,
        a pixel sees its own channel only. background is one radiance, or one for each colour. The splats' arrays must
        not change until backward() has run. Raises ConfigurationError for shapes that do not fit.
        """
        size = (self.camera.height, self.camera.width)
        if weights is not None:
            weights = np.ascontiguousarray(weights, np.float32)
            if weights.shape != (len(np.asarray(centres)), *size):
                raise ConfigurationError(f"weights are {weights.shape}, expected {(len(np.asarray(centres)), *size)}")
        return self._forward(splats, rotations, centres, weights, None, channels, background)

    def forward_moving(
        self,
        splats: AnySplats,
        rotations: ArrayLike,
        centres: ArrayLike,
        windows: Floats,
        *,
        channels: NDArray[np.uint8] | None = None,
        background: float | Sequence[float] = 0.0,
    ) -> RenderedImage:
        """Render what each pixel sees on average over its own time while the camera moves.

        The camera is at pose s, rotations [S + 1, 3, 3] camera to world and centres [S + 1, 3], at time s, and moves
        evenly from one to the next: S sub-frames. windows [2, H, W], float32, are the times in [0, S] when each pixel
        begins and ends to look; a pixel whose window is empty is 0 and has no gradients, and what lies outside of
        [0, S] does not count. Within a sub-frame splats move in straight lines on the screen, each pixel sees them at
        the middle of the time that it looks, and the rest of the motion is a blur by moment matching. That costs about
        as much as a render for each sub-frame; two sub-frames for two pixels of motion differ from exact renders by
        1 % of the picture's contrast (docs/performance.md). Everything else is as in `forward`; backward() gives the
        gradients by all S + 1 poses.
        """
        windows = checked_windows(windows, (self.camera.height, self.camera.width))
        if len(np.asarray(centres)) < 2:
            raise ConfigurationError("a moving camera needs two poses at least, at the beginning and at the end")
        return self._forward(splats, rotations, centres, None, windows, channels, background)

    def _forward(
        self,
        splats: AnySplats,
        rotations: ArrayLike,
        centres: ArrayLike,
        weights: Floats | None,
        windows: Floats | None,
        channels: NDArray[np.uint8] | None,
        background: float | Sequence[float],
    ) -> RenderedImage:
        rotations, centres = checked_poses(rotations, centres)
        arrays, count, colours = self._splats(splats)
        size = (self.camera.height, self.camera.width)
        if channels is not None:
            channels = checked_channels(channels, size, colours)
        backgrounds = _checked_background(background)
        values = np.empty(size if colours == 1 or channels is not None else (*size, 3), np.float32)
        alpha = np.empty(size, np.float32)
        depth = np.empty(size, np.float32)
        self._native.forward(*arrays, rotations, centres, weights, windows, channels, backgrounds, values, alpha, depth)
        self._inputs = (*arrays, weights, windows, channels)
        self._shapes = (count, colours, len(rotations))
        self._values_shape = values.shape
        return RenderedImage(values, alpha, depth)

    def backward(self, d_values: Floats) -> Gradients:
        """Gradients of sum(d_values * values) for the last forward(); d_values has the shape of its values.

        Raises ConfigurationError before any forward() and for another shape.
        """
        d_values = np.ascontiguousarray(d_values, np.float32)
        self._check_slope(d_values)
        n, colours, s = self._shapes
        out = Gradients(
            means=np.empty((n, 3), np.float32),
            quats=np.empty((n, 4), np.float32),
            log_scales=np.empty((n, 3), np.float32),
            opacity_logits=np.empty(n, np.float32),
            colours=np.empty((n, colours), np.float32),
            rotation=np.empty((s, 3)),
            centre=np.empty((s, 3)),
            contribution=np.empty(n, np.float32),
            radius_px=np.empty(n, np.float32),
        )
        self._native.backward(d_values, *out.arrays(), out.rotation, out.centre, out.contribution, out.radius_px)
        return out


def checked_poses(rotations: ArrayLike, centres: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[S, 3, 3] and [S, 3], contiguous. Raises ConfigurationError for other shapes, and where they are not finite."""
    rotations = np.ascontiguousarray(rotations, np.float64)
    centres = np.ascontiguousarray(centres, np.float64)
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3) or centres.shape != (len(rotations), 3):
        raise ConfigurationError(
            f"sub-poses are rotations [S, 3, 3] and centres [S, 3], not {rotations.shape} and {centres.shape}"
        )
    if len(rotations) == 0:
        raise ConfigurationError("a render needs at least one sub-pose")
    if not (np.isfinite(rotations).all() and np.isfinite(centres).all()):
        raise ConfigurationError("a sub-pose is not finite: the trajectory that it comes from is broken")
    return rotations, centres


def checked_windows(windows: Floats, size: tuple[int, int]) -> Floats:
    """[2, H, W], contiguous. Raises ConfigurationError for another shape, and where they are not finite."""
    windows = np.ascontiguousarray(windows, np.float32)
    if windows.shape != (2, *size):
        raise ConfigurationError(f"windows are {windows.shape}, expected {(2, *size)}: begin and end of each pixel's")
    if not np.isfinite(windows).all():
        raise ConfigurationError("a window is not finite: give a pixel that does not look an empty one, as 0, 0")
    return windows


def checked_channels(channels: NDArray[Any], size: tuple[int, int], colours: int) -> NDArray[np.uint8]:
    """As bytes. Raises ConfigurationError for other values than 0, 1 and 2: a cast would wrap or cut them."""
    given = np.asarray(channels)
    fits = given.shape == size and colours == 3 and np.issubdtype(given.dtype, np.integer)
    if not fits or ((given < 0) | (given > 2)).any():
        raise ConfigurationError(
            f"a mosaic needs whole channels 0 to 2 of shape {size} and splats of three colours, "
            f"not {given.dtype} of shape {given.shape} and {colours} colour(s)"
        )
    return np.ascontiguousarray(given, np.uint8)


def _checked_background(background: float | Sequence[float]) -> Floats:
    """Three values. Raises ConfigurationError."""
    given = np.asarray(background, np.float32)
    if given.shape not in ((), (1,), (3,)):
        raise ConfigurationError(f"a background is a number or red, green and blue, not of shape {given.shape}")
    return np.array(np.broadcast_to(given, 3))


def _checked_splats(splats: Scene) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    arrays = tuple(np.ascontiguousarray(array, np.float32) for array in splats.arrays())
    means, quats, log_scales, opacity_logits, colours = arrays
    if not Scene(means, quats, log_scales, opacity_logits, colours).well_formed:
        raise ConfigurationError(
            "splats are means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N] and colours [N, 1 or 3], not "
            + ", ".join(str(array.shape) for array in arrays)
        )
    return means, quats, log_scales, opacity_logits, colours
