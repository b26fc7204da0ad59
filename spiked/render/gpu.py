"""The rasteriser on a GPU: our own CUDA kernels behind the interface of `cpu.Rasteriser`, without torch.

The kernels' arithmetic is that of the CPU, compiled a second time (`spiked/native/gpu`). Two things differ: a pixel, not a
block of 4x4 pixels, is finished when it lets less than 1e-4 of the light through; and pixels whose window misses a sub-frame
add nothing to the contributions.
"""

from typing import Any, Literal

from spiked.errors import ConfigurationError
from spiked.native import _gpu
from spiked.render.camera import Camera
from spiked.render.cpu import Rasteriser

ARCHITECTURES: tuple[str, ...] = tuple(_gpu.architectures.split())
"""GPUs that the kernels of this build are machine code for, as sm_80; empty if it was built without nvcc."""


def missing() -> str | None:
    """Why no GPU can be used here; None if one can."""
    return str(_gpu.why_no_cuda()) or None


class GpuRasteriser(Rasteriser):
    """`Rasteriser` on a GPU: the same methods, shapes and errors. The same input gives the same bits.

    Splats, images and gradients are copied to and from the device at every call.
    """

    def __init__(self, camera: Camera, near: float = 0.01, device: Literal["cuda", "emulated"] = "cuda") -> None:
        """The emulated device runs the same kernels on the CPU, slowly: for tests. Raises ConfigurationError where there
        is no GPU."""
        self._emulated = device == "emulated"
        super().__init__(camera, 1, near)

    def _renderer(self, near: float, threads: int, **optics: Any) -> Any:
        try:
            return _gpu.renderer(near=near, emulated=self._emulated, **optics)
        except RuntimeError as error:
            raise ConfigurationError(f"cannot render on a GPU: {error}") from error
