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

import spiked.native._gpu as _gpu
from spiked.errors import ConfigurationError
from spiked.render.camera import Camera
from spiked.render.cpu import Rasteriser
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


class GpuRasteriser(Rasteriser):
    """`Rasteriser` on a GPU: the same methods, shapes and errors. The same input gives the same bits.

    Splats, images and gradients are copied to and from the device at every call.
    """

    def __init__(self, camera: Camera, near: float = 0.01, device: Literal["cuda", "emulated"] = "cuda") -> None:
        """The emulated device runs the same kernels on the CPU, slowly: for tests. Raises ConfigurationError where
        there is no GPU."""
        self._emulated = device == "emulated"
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

    def descend(
        self,
        d_values: Floats,
        scene: DeviceScene,
        rates: tuple[float, ...],
        axes: MeanAxes,
        beta1: float,
        beta2: float,
        epsilon: float,
        limits: SizeLimits,
    ) -> None:
        """`backward` and a step of Adam on the device, as in `Descent.step`. The last image was of `scene`, or of the
        splats that it was set to."""
        self._check_slope(d_values)
        with device_errors():
            self._native.descend(
                np.ascontiguousarray(d_values, np.float32), scene.native, np.array(rates, np.float32), axes.blur,
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
