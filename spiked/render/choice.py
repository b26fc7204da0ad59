"""Which rasteriser does the work: the GPU's where there is one, else the CPU's."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.errors import ConfigurationError
from spiked.render.camera import Camera
from spiked.render.cpu import Rasteriser
from spiked.render.splats import Floats, Gradients, Image, SplatArrays


class AnyRasteriser(Protocol):
    """What both rasterisers do; `cpu.Rasteriser` says how."""

    camera: Camera

    @property
    def instructions(self) -> str: ...

    def forward(
        self,
        splats: SplatArrays,
        rotations: ArrayLike,
        centres: ArrayLike,
        *,
        weights: Floats | None = None,
        channels: NDArray[np.uint8] | None = None,
        background: float | Sequence[float] = 0.0,
    ) -> Image: ...

    def forward_moving(
        self,
        splats: SplatArrays,
        rotations: ArrayLike,
        centres: ArrayLike,
        windows: Floats,
        *,
        channels: NDArray[np.uint8] | None = None,
        background: float | Sequence[float] = 0.0,
    ) -> Image: ...

    def backward(self, d_values: Floats) -> Gradients: ...


def rasteriser_for(camera: Camera, threads: int | None = None) -> AnyRasteriser:
    """The rasteriser that SPIKED_RENDER names, cpu or cuda; without it that of a GPU if one can be used.

    threads are the CPU's. torch is not even imported where no NVIDIA driver is loaded. Raises ConfigurationError where
    cuda is wanted and cannot be had.
    """
    wanted = os.environ.get("SPIKED_RENDER", "")
    if wanted not in ("", "cpu", "cuda"):
        raise ConfigurationError(f"SPIKED_RENDER={wanted} is no renderer: use cpu or cuda, or unset it")
    if wanted == "cuda":
        from spiked.render import cuda

        return cuda.CudaRasteriser(camera)
    if wanted == "" and Path("/proc/driver/nvidia/version").exists():
        try:
            from spiked.render import cuda
        except ImportError:
            return Rasteriser(camera, threads)
        if cuda.missing() is None:
            return cuda.CudaRasteriser(camera)
    return Rasteriser(camera, threads)
