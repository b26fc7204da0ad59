"""The rasteriser on a GPU: our own CUDA kernels behind the interface of `cpu.Rasteriser`, without torch.

The kernels' arithmetic is that of the CPU, compiled a second time (`spiked/native/gpu`). Two things differ: a pixel,
not a block of 4x4 pixels, is finished when it lets less than 1e-4 of the light through; and pixels whose window misses
a sub-frame add nothing to the contributions.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

import spiked.native._gpu as _gpu
from spiked.errors import ConfigurationError
from spiked.render.camera import Camera
from spiked.render.charge import WARP_CELL_PX, SpikeLayout, charge_means
from spiked.render.comparison import (
    ChargeCompared,
    ChargeTerms,
    Compared,
    DeviceFrame,
    DeviceLight,
    DeviceSpikes,
    RateTerms,
    ViewGains,
)
from spiked.render.cpu import Rasteriser, checked_channels, checked_poses, checked_windows
from spiked.render.splats import AnySplats, DeviceScene, Floats, Gradients, MeanAxes, RenderedImage, SizeLimits
from spiked.scene import Scene
from spiked.sensor import Intrinsics

ARCHITECTURES: tuple[str, ...] = tuple(_gpu.architectures.split())
"""GPUs that the kernels of this build are machine code for, as sm_80; empty if it was built without nvcc."""


@cache
def missing() -> str | None:
    """Why no GPU can be used here; None if one can: one splat is rendered and differentiated once a process."""
    reason = str(_gpu.why_no_cuda())
    if reason:
        return reason
    splat = Scene(
        np.array([[0, 0, 1]], np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), -1, np.float32),
        np.full(1, 2, np.float32),
        np.ones((1, 1), np.float32),
    )
    try:
        rasteriser = GpuRasteriser(Camera(Intrinsics(8, 8, 4, 4), 8, 8))
        values = rasteriser.forward(splat, np.eye(3)[None], np.zeros((1, 3))).values
        slope = rasteriser.backward(np.ones_like(values)).colours
    except (ConfigurationError, RuntimeError) as error:
        return f"the GPU cannot render: {error}. This build has kernels for {', '.join(ARCHITECTURES)} and later"
    return None if values[4, 4] > 0.1 and slope[0, 0] > 0 else "the GPU renders nothing: its driver may be damaged"


def device_name() -> str:
    """The name of the GPU. Raises RuntimeError without one."""
    return str(_gpu.cuda_device())


@contextmanager
def device_errors() -> Iterator[None]:
    """Raises ConfigurationError where the device fails, for instance for lack of memory."""
    try:
        yield
    except RuntimeError as error:
        raise ConfigurationError(
            f"{error}. Free its memory (nvidia-smi shows who uses it), or render on the CPU: SPIKED_RENDER=cpu"
        ) from error


@contextmanager
def _native_errors() -> Iterator[None]:
    """`device_errors`, and ConfigurationError for what does not fit."""
    try:
        with device_errors():
            yield
    except ValueError as error:
        raise ConfigurationError(f"scene, view and image do not fit: {error}") from error


class GpuRasteriser(Rasteriser):
    """`Rasteriser` on a GPU: the same methods, shapes and errors. The same input gives the same bits.

    Splats, images and gradients are copied to and from the device at every call, but for what is done to a
    `DeviceScene`: its splats stay there, and where it is compared with a `DeviceFrame`, images and gradients do, too.
    """

    def __init__(self, camera: Camera, near: float = 0.01, device: Literal["cuda", "emulated"] = "cuda") -> None:
        """The emulated device runs the same kernels on the CPU, slowly: for tests. Raises ConfigurationError where
        there is no GPU."""
        self._emulated = device == "emulated"
        self._gain: Floats | None = None
        """The gains on the device."""
        self._frame: DeviceFrame | None = None
        """The view that the last image was compared with."""
        self._charge_colours = 1
        super().__init__(camera, 1, near)

    def _forward(self, *inputs: Any) -> RenderedImage:
        with device_errors():
            return super()._forward(*inputs)

    def backward(self, d_values: Floats) -> Gradients:
        """See `Rasteriser.backward`."""
        with device_errors():
            return super().backward(d_values)

    def device_scene(self) -> DeviceScene:
        """A scene on this device, empty."""
        return DeviceScene(self._native.scene())

    def frame(
        self, rates: Floats, deviation: Floats, windows: Floats | None, channels: NDArray[np.uint8] | None = None
    ) -> DeviceFrame:
        """A view on this device: rates and their deviations [H, W] or [H, W, 3], infinite where nothing was seen, the
        windows [2, H, W] of `forward_moving` or None for a camera that stands still, and a mosaic's channels [H, W]."""
        arrays = [np.ascontiguousarray(array, np.float32) for array in (rates, deviation)]
        size = (self.camera.height, self.camera.width)
        if windows is not None:
            windows = checked_windows(windows, size)
        if channels is not None:
            channels = checked_channels(channels, size, 3)
        parts = [array for array in (*arrays, windows, channels) if array is not None]
        with _native_errors():
            return DeviceFrame(self._native.frame(*arrays, windows, channels), sum(part.nbytes for part in parts))

    def compare(
        self,
        scene: DeviceScene,
        rotations: ArrayLike,
        centres: ArrayLike,
        frame: DeviceFrame,
        terms: RateTerms,
        gains: ViewGains | None = None,
        background: float = 0.0,
    ) -> Compared:
        """Render a scene from the poses, as `forward` or `forward_moving` with the windows of a frame, and compare the
        image with that.

        The image and the gradient of the loss by it, (1 - ssim) error + ssim * ssim_scale * unlike, stay on the device
        for `descend` and `add_evidence`. SSIM of a mosaic is that of grey images.
        """
        poses = checked_poses(rotations, centres)
        with _native_errors():
            if gains is not None and gains.gain is not self._gain:
                self._native.set_gains(np.ascontiguousarray(gains.gain, np.float32))
                self._gain = gains.gain
            error, similarity, expected, seen = self._native.compare(
                scene.native, frame.native, *poses, np.full(3, background, np.float32),
                white=terms.white, floor=terms.floor, share=terms.ssim, scale=terms.ssim_scale,
                level=None if gains is None else gains.level,
                model_error=0.0 if gains is None else gains.model_error,
                sigmas=0.0 if gains is None else gains.sigmas,
            )  # fmt: skip
        self._inputs = None  # backward() needs the slope of an image that was brought here
        self._frame = frame  # its windows are needed until descend() is done; a refused one leaves the last
        return Compared(error, 1 - similarity, expected, seen)

    def slope(self, shape: tuple[int, ...]) -> Floats:
        """The gradient of the last comparison by its image, of that shape."""
        out = np.empty(shape, np.float32)
        with _native_errors():
            self._native.slope(out)
        return out

    def add_evidence(self, level: float, model_error: float) -> None:
        """Add the last comparison with a view to the evidence of the pixels' gains, see `Nuisances.observe`."""
        if self._frame is None:
            raise ConfigurationError("evidence is of an image and a view, and the last image was not compared with one")
        with _native_errors():
            self._native.add_evidence(self._frame.native, level, model_error)

    def set_evidence(self, xx: Floats, xy: Floats) -> None:
        """Set the evidence of the pixels' gains: sums xx and xy [H, W] of normal equations."""
        with _native_errors():
            self._native.set_evidence(xx, xy)

    def evidence(self) -> tuple[Floats, Floats]:
        """The evidence that was set, with what was added to it since."""
        size = (self.camera.height, self.camera.width)
        xx, xy = np.empty(size, np.float32), np.empty(size, np.float32)
        with _native_errors():
            self._native.evidence(xx, xy)
        return xx, xy

    def spikes(self, frames: NDArray[np.uint8], layout: SpikeLayout) -> DeviceSpikes:
        """Frames [n, frame_bytes] on this device, at most 64."""
        with _native_errors():
            return DeviceSpikes(self._native.spikes(np.ascontiguousarray(frames), **layout), frames.nbytes)

    def light(self, gain: Floats, dark: Floats | None) -> DeviceLight:
        """What multiplies the light of a sensor's pixels [H, W] (0: one that does not count), and what is added."""
        arrays = [None if array is None else np.ascontiguousarray(array, np.float32) for array in (gain, dark)]
        with _native_errors():
            return DeviceLight(self._native.light(*arrays))

    def compare_charge(
        self,
        scene: DeviceScene,
        rotations: ArrayLike,
        centres: ArrayLike,
        spikes: DeviceSpikes,
        light: DeviceLight,
        motion: tuple[Floats, Floats],
        terms: ChargeTerms,
        background: float = 0.0,
    ) -> ChargeCompared:
        """Render a scene from one pose, [1, 3, 3] and [1, 3], and compare the image with the spikes of frames to which
        it is warped, `motion` as of `FrameWarp.motion`.

        The camera has no distortion. The gradient of the loss by the image stays on the device for `descend`.
        """
        poses = checked_poses(rotations, centres)
        turn, shift = (np.ascontiguousarray(part, np.float32) for part in motion)
        if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
            raise ConfigurationError("the motion from frames to the image is not finite")
        with _native_errors():
            sums = self._native.compare_charge(
                scene.native, spikes.native, light.native, *poses, np.full(3, background, np.float32), turn, shift,
                cell=WARP_CELL_PX, nearest=terms.nearest, pixel=terms.pixel, every=terms.pixel, phase=terms.phase,
                level=terms.level, floor=terms.floor, jitter=terms.jitter, white=terms.white,
                detail=terms.detail, window=_detail_window(terms.detail_px),
            )  # fmt: skip
        self._inputs, self._frame, self._charge_colours = None, None, int(scene.native.colours)
        return ChargeCompared(*charge_means(*sums))

    def charge_slope(self) -> Floats:
        """`Charge.slope` of the last comparison with spikes, [H, W] or [H, W, 3]: without detail, and not divided."""
        size = (self.camera.height, self.camera.width)
        out = np.empty(size if self._charge_colours == 1 else (*size, 3), np.float32)
        with _native_errors():
            self._native.charge_slope(out)
        return out

    def descend(
        self,
        d_values: Floats | None,
        scene: DeviceScene,
        rates: tuple[float, ...],
        axes: MeanAxes,
        beta1: float,
        beta2: float,
        epsilon: float,
        limits: SizeLimits,
    ) -> None:
        """`backward` and a step of Adam on the device, as in `Descent.step`. The last image was of `scene`, or of the
        splats that it was set to; without `d_values` it was compared, and the gradient is that of its loss."""
        if d_values is not None:
            self._check_slope(d_values)
            d_values = np.ascontiguousarray(d_values, np.float32)
        with _native_errors():
            self._native.descend(
                d_values, scene.native, np.array(rates, np.float32), axes.blur,
                axes.own, beta1, beta2, epsilon, limits.log_scale, limits.widest, np.array(limits.centre, np.float32),
            )  # fmt: skip

    def _splats(self, splats: AnySplats) -> tuple[tuple[Any, ...], int, int]:
        if isinstance(splats, DeviceScene):
            return (splats.native,), len(splats), int(splats.native.colours)
        return super()._splats(splats)

    def _renderer(self, near: float, threads: int, **optics: Any) -> Any:
        try:
            return _gpu.renderer(near=near, emulated=self._emulated, **optics)
        except RuntimeError as error:
            raise ConfigurationError(f"cannot render on a GPU: {error}") from error


def _detail_window(sigma_px: float) -> Floats:
    """Weights of pixels 0 to 6 from the middle, of 13 that `cv2.GaussianBlur` takes for a sigma of 1.5 px."""
    weights = np.exp(-0.5 * (np.arange(-6, 7) / sigma_px) ** 2)
    return np.asarray((weights / weights.sum())[6:], np.float32)
