"""The oracle: the same renderer in float64 torch with automatic differentiation, for tiny scenes.

It states the model without regard for speed: every splat is evaluated at every pixel. Two things differ from the CPU
renderer. It never stops at a low transmittance, which changes an image by at most 1e-4 of its brightest splat; and the
rounding of a float64 decides which side of 1/255 an alpha falls on. Formulas: Zwicker et al., EWA splatting (2001), as
used by 3D Gaussian splatting (Kerbl et al. 2023).
"""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from spiked.distortion import Distortion, LensModel
from spiked.render.camera import Camera
from spiked.scene import Scene

LENS_DILATION_PX2 = 0.05
"""Part of the dilation that is added in the picture of a lens, px^2; the rest is bent with the picture."""
DILATION_PX2 = 0.3
"""Added to the diagonal of a projected covariance, px^2. This and the next three are the values of the code of 3D
Gaussian splatting (Kerbl et al. 2023)."""
ALPHA_CAP = 0.99
"""Upper bound of a splat's alpha at a pixel."""
ALPHA_CUT = 1 / 255
"""A splat is not blended at pixels where its alpha is lower."""
SLOPE_LIMIT = 1.3
"""The projection's Jacobian is taken at x/z and y/z clamped to this multiple of the half field of view."""


@dataclass(frozen=True)
class Parameters:
    """Leaves of the differentiation, float64 with gradients; shapes as in `Scene`, S sub-poses."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    colours: Tensor
    turns: Tensor
    """phi in R <- Exp(phi) R, zeros [S, 3]."""
    centres: Tensor
    """[S, 3]"""

    @classmethod
    def of(cls, splats: Scene, centres: ArrayLike) -> "Parameters":
        """The splats and camera centres as leaves."""

        def leaf(array: ArrayLike) -> Tensor:
            return torch.tensor(np.asarray(array, np.float64), requires_grad=True)

        positions = np.asarray(centres, np.float64)
        return cls(
            leaf(splats.means),
            leaf(splats.quats),
            leaf(splats.log_scales),
            leaf(splats.opacity_logits),
            leaf(splats.colours),
            leaf(np.zeros_like(positions)),
            leaf(positions),
        )


def render(
    parameters: Parameters,
    camera: Camera,
    rotations: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    channels: NDArray[np.uint8] | None = None,
    background: float = 0.0,
    near: float = 0.01,
) -> tuple[Tensor, Tensor, Tensor]:
    """Values, alpha and depth as in `spiked.render.RenderedImage`, differentiable in the parameters."""
    turns = torch.tensor(np.asarray(rotations, np.float64))
    count = len(turns)
    shape = (count, camera.height, camera.width)
    weight = torch.full(shape, 1 / count, dtype=torch.float64)
    if weights is not None:
        weight = torch.tensor(np.asarray(weights, np.float64))
    values = torch.zeros(camera.height, camera.width, parameters.colours.shape[1], dtype=torch.float64)
    alpha = torch.zeros(shape[1:], dtype=torch.float64)
    depth = torch.zeros(shape[1:], dtype=torch.float64)
    for s in range(count):
        rotation = torch.linalg.matrix_exp(_cross(parameters.turns[s])) @ turns[s]
        one_values, one_alpha, one_depth = render_pose(
            parameters, camera, (rotation, parameters.centres[s]), background, near
        )
        values = values + weight[s, :, :, None] * one_values
        alpha = alpha + weight[s] * one_alpha
        depth = depth + weight[s] * one_depth
    depth = torch.where(alpha > 0, depth / torch.where(alpha > 0, alpha, 1.0), 0.0)
    total = weight.sum(0)
    alpha = torch.where(total > 0, alpha / torch.where(total > 0, total, 1.0), 0.0)
    if channels is not None:
        values = torch.gather(values, 2, torch.tensor(channels.astype(np.int64))[:, :, None])
    return (values[:, :, 0] if values.shape[2] == 1 else values), alpha, depth


def render_moving(
    parameters: Parameters,
    camera: Camera,
    rotations: ArrayLike,
    windows: ArrayLike,
    *,
    channels: NDArray[np.uint8] | None = None,
    background: float = 0.0,
    near: float = 0.01,
) -> Tensor:
    """Values as of `Rasteriser.forward_moving`, differentiable in the parameters; windows [2, H, W]."""
    turns = torch.tensor(np.asarray(rotations, np.float64))
    start, stop = torch.tensor(np.asarray(windows, np.float64))
    projections = [
        _project(
            parameters,
            camera,
            (torch.linalg.matrix_exp(_cross(parameters.turns[s])) @ turns[s], parameters.centres[s]),
        )
        for s in range(len(turns))
    ]
    values = torch.zeros(camera.height, camera.width, parameters.colours.shape[1], dtype=torch.float64)
    for s, (begin, end) in enumerate(itertools.pairwise(projections)):
        low, high = start.clamp(min=s), stop.clamp(max=s + 1)
        length = (high - low).clamp(min=0)
        weight = torch.where(length > 0, length / (stop - start), 0.0)
        if not weight.any():
            continue
        blur = (weight * length**2).sum() / weight.sum() / 12
        time = torch.where(length > 0, (low + high) / 2 - s - 0.5, 0.0)
        motion = end.centres - begin.centres
        half = (begin.halves + end.halves) / 2
        sharp = half @ half.transpose(1, 2) + begin.dilation
        blurred = sharp + blur * motion[:, :, None] * motion[:, None, :]
        fade = torch.sqrt(torch.linalg.det(sharp) / torch.linalg.det(blurred))
        order = torch.argsort((begin.z + end.z).detach(), stable=True)
        order = order[(torch.minimum(begin.z, end.z)[order].detach() >= near)]
        centres = (begin.centres + end.centres) / 2
        splats = _OnScreen(centres[order], blurred[order], ((begin.z + end.z) / 2)[order], motion[order])
        opacity = (torch.sigmoid(parameters.opacity_logits) * fade)[order]
        one, _, _ = _composite(camera, splats, opacity, parameters.colours[order], background, time)
        values = values + weight[:, :, None] * one
    if channels is not None:
        values = torch.gather(values, 2, torch.tensor(channels.astype(np.int64))[:, :, None])
    return values[:, :, 0] if values.shape[2] == 1 else values


@dataclass(frozen=True)
class _Projection:
    centres: Tensor
    """Means on screen, px; [N, 2]."""
    halves: Tensor
    """M whose M M^T is the covariance on screen without `dilation`; [N, 2, 3], or [N, 2, 5] through a lens."""
    z: Tensor
    dilation: Tensor
    """What is added to the covariances, [2, 2]."""


@dataclass(frozen=True)
class _OnScreen:
    """By depth: means [N, 2], covariances [N, 2, 2], depths [N], and motion over a sub-frame [N, 2]."""

    centres: Tensor
    covariances: Tensor
    z: Tensor
    motion: Tensor | None = None


def _project(parameters: Parameters, camera: Camera, pose: tuple[Tensor, Tensor]) -> _Projection:
    rotation, centre = pose
    k = camera.intrinsics
    x, y, z = ((parameters.means - centre) @ rotation).unbind(1)
    limit_x, limit_y, reach = _limits(camera)
    zero = torch.zeros_like(z)
    slope_x = (x / z).clamp(-limit_x, limit_x)
    slope_y = (y / z).clamp(-limit_y, limit_y)
    jacobian = torch.stack([k.fx / z, zero, -k.fx * slope_x / z, zero, k.fy / z, -k.fy * slope_y / z], 1).view(-1, 2, 3)
    spread = _rotations(parameters.quats) * torch.exp(parameters.log_scales)[:, None, :]
    halves = jacobian @ rotation.T @ spread
    dilation = DILATION_PX2
    seen_x, seen_y = x / z, y / z
    if k.distortion is not None:
        z = torch.where(seen_x**2 + seen_y**2 <= reach**2, z, zero)  # beyond its reach a lens would fold the image
        seen_x, seen_y, bend = _bent(k.distortion, seen_x, seen_y)
        focal = torch.tensor([k.fx, k.fy], dtype=torch.float64)
        bend = focal[:, None] * bend / focal
        bent_dilation = np.sqrt(DILATION_PX2 - LENS_DILATION_PX2) * torch.eye(2, dtype=torch.float64)
        halves = bend @ torch.cat([halves, bent_dilation.expand(len(z), 2, 2)], 2)
        dilation = LENS_DILATION_PX2
    centres = torch.stack([k.fx * seen_x + k.cx, k.fy * seen_y + k.cy], 1)
    return _Projection(centres, halves, z, dilation * torch.eye(2, dtype=torch.float64))


def _limits(camera: Camera) -> tuple[float, float, float]:
    """Largest |x/z| and |y/z| at which the Jacobian is taken, and through a lens the largest slope that is drawn."""
    k, width, height = camera.intrinsics, camera.width, camera.height
    if k.distortion is None:
        return SLOPE_LIMIT * 0.5 * width / k.fx, SLOPE_LIMIT * 0.5 * height / k.fy, np.inf
    border = [(x, y) for x in range(width) for y in (0, height)] + [(x, y) for y in range(height) for x in (0, width)]
    slopes = k.unproject(np.array(border, np.float64))[:, :2]
    across, down = SLOPE_LIMIT * np.abs(slopes).max(0)
    farthest = SLOPE_LIMIT * np.linalg.norm(slopes, axis=1).max()
    return float(across), float(down), min(k.distortion.reach, float(farthest))


def _bent(lens: Distortion, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes [N] and [N] bent by a lens, and their derivative [N, 2, 2] by the slopes."""
    square = x * x + y * y
    p1 = p2 = 0.0
    if lens.model is LensModel.OPENCV:
        k1, k2, p1, p2, k3 = lens.coefficients
        scale = 1 + square * (k1 + square * (k2 + square * k3))
        growth = k1 + square * (2 * k2 + 3 * square * k3)
    else:
        r = torch.sqrt(square)
        angle = torch.atan(r)
        t = angle**2
        k = lens.coefficients
        scale = angle * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))) / r
        by_angle = 1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * 9 * k[3])))
        growth = (by_angle / (1 + square) - scale) / (2 * square)
    mixed = 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y
    xx = scale + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x
    yy = scale + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x
    seen_x = x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    seen_y = y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return seen_x, seen_y, torch.stack([xx, mixed, mixed, yy], 1).view(-1, 2, 2)


def render_pose(
    parameters: Parameters, camera: Camera, pose: tuple[Tensor, Tensor], background: float, near: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Values [H, W, C], alpha [H, W] and depth sum [H, W] from one camera-to-world pose.

    The pose is rotation [3, 3] and centre [3]; splats nearer than `near` are left out.
    """
    seen = _project(parameters, camera, pose)
    order = torch.argsort(seen.z.detach(), stable=True)
    order = order[seen.z[order].detach() >= near]
    half = seen.halves[order]
    covariance = half @ half.transpose(1, 2) + seen.dilation
    splats = _OnScreen(seen.centres[order], covariance, seen.z[order])
    opacity = torch.sigmoid(parameters.opacity_logits[order])
    return _composite(camera, splats, opacity, parameters.colours[order], background, None)


def _composite(
    camera: Camera, splats: _OnScreen, opacity: Tensor, colours: Tensor, background: float, time: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Values [H, W, C], alpha and depth sum [H, W] of splats in order of depth; time [H, W] where they move."""
    conic = torch.linalg.inv(splats.covariances)
    rows = torch.arange(camera.height, dtype=torch.float64) + 0.5
    columns = torch.arange(camera.width, dtype=torch.float64) + 0.5
    dx = columns[None, None, :] - splats.centres[:, 0, None, None]
    dy = rows[None, :, None] - splats.centres[:, 1, None, None]
    if splats.motion is not None and time is not None:
        dx = dx - splats.motion[:, 0, None, None] * time
        dy = dy - splats.motion[:, 1, None, None] * time
    a, b, c = (conic[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    power = -0.5 * (a * dx**2 + c * dy**2) - b * dx * dy
    alpha = opacity[:, None, None] * torch.exp(power)
    alpha = torch.where(alpha >= ALPHA_CUT, alpha.clamp(max=ALPHA_CAP), 0.0)

    through = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(through[:1]), through[:-1]])
    share = alpha * before
    left = through[-1] if len(through) else torch.ones(camera.height, camera.width, dtype=torch.float64)
    values = torch.einsum("nhw,nc->hwc", share, colours) + background * left[:, :, None]
    return values, 1 - left, torch.einsum("nhw,n->hw", share, splats.z)


def _cross(v: Tensor) -> Tensor:
    zero = torch.zeros_like(v[0])
    return torch.stack([zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero]).view(3, 3)


def _rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4] of any length."""
    w, x, y, z = (quats / torch.linalg.norm(quats, dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, 1).view(-1, 3, 3)
