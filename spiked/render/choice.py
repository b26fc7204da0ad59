"""Chooses the rasteriser: the GPU's if one can be used, else the CPU's."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.errors import ConfigurationError
from spiked.render import gpu
from spiked.render.camera import Camera
from spiked.render.cpu import Rasteriser
from spiked.render.splats import AnySplats, Floats, Gradients, RenderedImage

DRIVER = Path("/proc/driver/nvidia/version")
"""Exists while an NVIDIA driver is loaded."""
_log = logging.getLogger("spiked.render")


class AnyRasteriser(Protocol):
    """Interface of both rasterisers; documented at `cpu.Rasteriser`."""

    camera: Camera

    @property
    def instructions(self) -> str:
        """See `cpu.Rasteriser.instructions`."""

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
        """See `cpu.Rasteriser.forward`."""

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
        """See `cpu.Rasteriser.forward_moving`."""

    def backward(self, d_values: Floats) -> Gradients:
        """See `cpu.Rasteriser.backward`."""


@dataclass(frozen=True)
class Choice:
    """The chosen renderer and the reason."""

    renderer: Literal["cpu", "cuda", "emulated"]
    reason: str
    unused: bool = False
    """A GPU is there, and cannot be rendered with."""

    def __str__(self) -> str:
        return f"{self.renderer} ({self.reason})"


def chosen() -> Choice:
    """The renderer that SPIKED_RENDER names, cpu or cuda; without it the GPU's if it can render here. For tests it may
    also be emulated: the GPU's kernels on the CPU, slowly.

    Where an NVIDIA driver is loaded, a GPU that cannot be used is said in the log, once a process. Raises
    ConfigurationError where cuda is wanted and cannot be had.
    """
    return choice_for(os.environ.get("SPIKED_RENDER", ""))


@cache
def choice_for(wanted: str) -> Choice:
    """The renderer for a value of SPIKED_RENDER (cpu, cuda, emulated or empty), once. Raises ConfigurationError."""
    if wanted == "emulated":
        return Choice("emulated", "SPIKED_RENDER asks for it")
    if wanted not in ("", "cpu", "cuda"):
        raise ConfigurationError(f"SPIKED_RENDER={wanted} is no renderer: use cpu or cuda, or unset it")
    if wanted == "cpu":
        return Choice("cpu", "SPIKED_RENDER asks for it")
    reason = gpu.missing()
    if reason is None:
        return Choice("cuda", gpu.device_name() if wanted == "" else "SPIKED_RENDER asks for it")
    if wanted == "cuda":
        raise ConfigurationError(f"cannot render on a GPU: {reason}")
    if not DRIVER.exists():
        return Choice("cpu", "no NVIDIA driver is loaded")
    _log.warning("the GPU is not used: %s", reason)
    return Choice("cpu", reason, unused=True)


def rasteriser_for(camera: Camera, threads: int | None = None) -> AnyRasteriser:
    """A rasteriser of the kind that is `chosen`; threads are the CPU's. Raises ConfigurationError as that does."""
    renderer = chosen().renderer
    return Rasteriser(camera, threads) if renderer == "cpu" else gpu.GpuRasteriser(camera, device=renderer)
