"""The rasteriser on a GPU: gsplat's kernels behind the interface of `cpu.Rasteriser` (extra `spiked[cuda]`).

Constants are the same but two: gsplat caps alpha at 0.999 where the CPU caps it at 0.99, and stops a pixel, not a block
of pixels, when it lets less than 1e-4 of the light through. Splats below both caps give the same picture.
"""

import importlib.util
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from spiked.errors import ConfigurationError
from spiked.pose import exp_so3, log_so3
from spiked.render.camera import Camera
from spiked.render.splats import Floats, Gradients, RenderedImage
from spiked.scene import Scene
from spiked.sensor import Intrinsics

DEVICE = "cuda"
"""Where torch computes."""
INSTANTS = 4
"""Renders for each sub-frame of a moving camera; all of them are one batch."""

Rasterisation = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
"""`gsplat.rasterization`, or what stands in for it."""


def missing() -> str | None:
    """Why no GPU can be used here; None if one can."""
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed: pip install 'spiked[cuda]'"
    if not torch.cuda.is_available():
        return "torch sees no CUDA device: look with nvidia-smi, and install a torch built for CUDA"
    return trial()


@cache
def trial() -> str | None:
    """What goes wrong when one splat is rendered and differentiated.

    Without the CUDA toolkit gsplat imports all the same, and fails only here.
    """
    camera = Camera(Intrinsics(8, 8, 4, 4), 8, 8)
    splat = Scene(
        np.array([[0, 0, 1]], np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), -1, np.float32),
        np.full(1, 2, np.float32),
        np.ones((1, 1), np.float32),
    )
    try:
        import gsplat

        rasteriser = CudaRasteriser(camera, rasterisation=gsplat.rasterization)
        values = rasteriser.forward(splat, np.eye(3)[None], np.zeros((1, 3))).values
        slope = rasteriser.backward(np.ones_like(values)).colours
    except Exception as error:  # whatever a foreign library fails with, the CPU can do the work
        return (
            f"gsplat cannot render here ({type(error).__name__}: {error}): install the CUDA toolkit, "
            "with whose nvcc gsplat compiles its kernels"
        )
    if not (values[4, 4] > 0.1 and slope[0, 0] > 0):
        return "gsplat renders nothing here: install the build of torch and gsplat for this GPU"
    return None


class CudaRasteriser:
    """`cpu.Rasteriser` on a GPU: the same methods, shapes and errors; float32 like there.

    A moving camera is rendered at INSTANTS exact poses for each sub-frame, in one batch, instead of a blur.
    `Gradients.radius_px` is the larger half side of the splat's box, rounded up.
    """

    def __init__(
        self,
        camera: Camera,
        near: float = 0.01,
        *,
        device: str | None = None,
        rasterisation: Rasterisation | None = None,
    ) -> None:
        """Raises ConfigurationError where there is no GPU or no gsplat; `rasterisation` replaces the latter."""
        if rasterisation is None:
            reason = missing()
            if reason is not None:
                raise ConfigurationError(f"cannot render on a GPU: {reason}")
            import gsplat

            rasterisation = gsplat.rasterization
        if not near > 0:
            raise ConfigurationError(f"the near plane is at {near:g}: it must be positive")
        self.camera = camera
        self._near = near
        self._device = torch.device(device or DEVICE)
        self._rasterisation = rasterisation
        k = camera.intrinsics
        self._intrinsics = torch.tensor(
            [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]], dtype=torch.float32, device=self._device
        )
        self._last: _Pass | None = None

    @property
    def instructions(self) -> str:
        """What does the work."""
        return "cuda"

    def forward(
        self,
        splats: Scene,
        rotations: ArrayLike,
        centres: ArrayLike,
        *,
        weights: Floats | None = None,
        channels: NDArray[np.uint8] | None = None,
        background: float | Sequence[float] = 0.0,
    ) -> RenderedImage:
        """As `cpu.Rasteriser.forward`."""
        turned, places = self._poses(rotations, centres, 1)
        size = (self.camera.height, self.camera.width)
        if weights is None:
            weights = np.full((len(turned), 1, 1), 1 / len(turned), np.float32)
        elif weights.shape != (len(turned), *size):
            raise ConfigurationError(f"weights are {weights.shape}, expected {(len(turned), *size)}")
        return self._render(splats, turned, places, np.eye(len(turned)), weights, channels, background)

    def forward_moving(
        self,
        splats: Scene,
        rotations: ArrayLike,
        centres: ArrayLike,
        windows: Floats,
        *,
        channels: NDArray[np.uint8] | None = None,
        background: float | Sequence[float] = 0.0,
    ) -> RenderedImage:
        """As `cpu.Rasteriser.forward_moving`."""
        turned, places = self._poses(rotations, centres, 2)
        size = (self.camera.height, self.camera.width)
        windows = np.asarray(windows, np.float32)
        if windows.shape != (2, *size):
            raise ConfigurationError(
                f"windows are {windows.shape}, expected {(2, *size)}: begin and end of each pixel's"
            )
        if not np.isfinite(windows).all():
            raise ConfigurationError("a window is not finite: give a pixel that does not look an empty one, as 0, 0")
        instants = (len(turned) - 1) * INSTANTS
        edges = (np.arange(instants + 1, dtype=np.float32) / INSTANTS)[:, None, None]
        start, stop = windows
        overlap = np.clip(np.minimum(stop, edges[1:]) - np.maximum(start, edges[:-1]), 0, None)
        weights = overlap / np.where(stop > start, stop - start, 1)
        # To first order in the small turn between two poses, an instant's perturbation is the mean of theirs.
        blend = np.zeros((instants, len(turned)))
        between = np.empty((instants, 3, 3))
        for i, time in enumerate((np.arange(instants) + 0.5) / INSTANTS):
            s, share = int(time), time - int(time)
            blend[i, s : s + 2] = 1 - share, share
            between[i] = exp_so3(share * log_so3(turned[s + 1] @ turned[s].T)) @ turned[s]
        return self._render(splats, between, places, blend, weights.astype(np.float32), channels, background)

    def backward(self, d_values: Floats) -> Gradients:
        """As `cpu.Rasteriser.backward`."""
        last = self._last
        if last is None:
            raise ConfigurationError("backward() differentiates the last forward(), and there was none")
        if d_values.shape != tuple(last.values.shape):
            raise ConfigurationError(f"d_values is {d_values.shape}, expected {tuple(last.values.shape)} as rendered")
        slope = torch.from_numpy(np.ascontiguousarray(d_values, np.float32)).to(self._device)
        leaves = (*last.leaves, last.shares)
        # The extra channel's splats are black, so that its slope reaches nothing but their shares of the pixels.
        found = torch.autograd.grad(
            (last.values, last.seen),
            leaves,
            (slope, torch.full_like(last.seen, 1 / len(last.seen))),
            retain_graph=True,
            allow_unused=True,
        )
        arrays = [
            (torch.zeros_like(leaf) if grad is None else grad).detach().cpu().numpy()
            for grad, leaf in zip(found, leaves, strict=True)
        ]
        means, quats, log_scales, opacity_logits, colours, turns, centres, shares = arrays
        return Gradients(
            means,
            quats,
            log_scales,
            opacity_logits,
            colours,
            turns.astype(np.float64),
            centres.astype(np.float64),
            np.ascontiguousarray(shares[:, 0]),
            last.radii.amax(0).cpu().numpy().astype(np.float32),
        )

    def _poses(
        self, rotations: ArrayLike, centres: ArrayLike, least: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        turned, places = np.asarray(rotations, np.float64), np.asarray(centres, np.float64)
        if turned.ndim != 3 or turned.shape[1:] != (3, 3) or places.shape != (len(turned), 3):
            raise ConfigurationError(
                f"sub-poses are rotations [S, 3, 3] and centres [S, 3], not {turned.shape} and {places.shape}"
            )
        if len(turned) < least:
            raise ConfigurationError(f"a render needs at least {least} pose(s), not {len(turned)}")
        if not (np.isfinite(turned).all() and np.isfinite(places).all()):
            raise ConfigurationError("a sub-pose is not finite: the trajectory that it comes from is broken")
        return turned, places

    def _render(
        self,
        splats: Scene,
        rotations: NDArray[np.float64],
        centres: NDArray[np.float64],
        blend: NDArray[np.float64],
        weights: Floats,
        channels: NDArray[np.uint8] | None,
        background: float | Sequence[float],
    ) -> RenderedImage:
        """blend [renders, poses] says how each render's pose follows the given ones; weights [renders, H, W]."""
        arrays = (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.colours)
        colours = arrays[4].shape[1]
        size = (self.camera.height, self.camera.width)
        if channels is not None and (channels.shape != size or colours != 3):
            raise ConfigurationError(f"a mosaic needs channels of shape {size} and splats of three colours")
        leaves = tuple(self._tensor(array).requires_grad_() for array in arrays)
        means, quats, log_scales, opacity_logits, colour = leaves
        shares = torch.zeros(len(means), 1, device=self._device, requires_grad=True)
        turns = torch.zeros(blend.shape[1], 3, device=self._device, requires_grad=True)
        # Far from the origin float32 loses the centre's digits: the world is moved to the first pose instead.
        origin = centres[0]
        places = self._tensor(centres - origin).requires_grad_()
        mixed = self._tensor(blend)
        turned = (torch.eye(3, device=self._device) + _cross(mixed @ turns)) @ self._tensor(rotations)
        views = torch.zeros(len(blend), 4, 4, device=self._device)
        views[:, 3, 3] = 1
        views[:, :3, :3] = turned.transpose(1, 2)
        views[:, :3, 3] = -(turned.transpose(1, 2) @ (mixed @ places)[:, :, None])[:, :, 0]
        behind = self._tensor(np.broadcast_to(np.asarray(background, np.float32), colours))
        rendered, alphas, info = self._rasterisation(
            means - self._tensor(origin),
            quats,
            torch.exp(log_scales),
            torch.sigmoid(opacity_logits),
            torch.cat([colour, shares], 1),
            views,
            self._intrinsics.expand(len(blend), 3, 3),
            self.camera.width,
            self.camera.height,
            near_plane=self._near,
            eps2d=0.3,
            packed=False,
            backgrounds=torch.cat([behind, behind.new_zeros(1)]).expand(len(blend), colours + 1),
            render_mode="RGB+D",
        )
        weight = self._tensor(weights)[..., None]
        values = (weight * rendered[..., :colours]).sum(0)
        if channels is not None:
            values = torch.gather(values, 2, torch.from_numpy(channels.astype(np.int64)).to(self._device)[:, :, None])
        values = values[:, :, 0] if values.shape[2] == 1 else values
        opaque = (weight * alphas).sum(0)[:, :, 0]
        total = weight.sum(0)[:, :, 0].expand(size)
        distance = (weight * rendered[..., colours + 1 :]).sum(0)[:, :, 0]
        self._last = _Pass((*leaves, turns, places), shares, values, rendered[..., colours], _largest(info["radii"]))
        alpha = torch.where(total > 0, opaque / total.clamp(min=1e-30), 0)
        depth = torch.where(opaque > 0, distance / opaque.clamp(min=1e-30), 0)
        return RenderedImage(*(tensor.detach().cpu().numpy() for tensor in (values, alpha, depth)))

    def _tensor(self, array: ArrayLike) -> Tensor:
        return torch.tensor(np.asarray(array), dtype=torch.float32, device=self._device)


class _Pass:
    """What backward() needs of the last forward()."""

    def __init__(self, leaves: tuple[Tensor, ...], shares: Tensor, values: Tensor, seen: Tensor, radii: Tensor) -> None:
        self.leaves, self.shares, self.values, self.seen, self.radii = leaves, shares, values, seen, radii


def _largest(radii: Tensor) -> Tensor:
    """Radii [S, N] of what gsplat gives, [S, N, 2] since its version 1.5."""
    return radii.amax(-1) if radii.ndim == 3 else radii


def _cross(v: Tensor) -> Tensor:
    """Cross product matrices [S, 3, 3] of [S, 3]."""
    x, y, z = v.unbind(1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
