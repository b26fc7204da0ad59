"""The GPU path. Without a GPU its own part is tested with a small renderer in the place of gsplat's kernels."""

from typing import Any

import numpy as np
import pytest
import render_scenes as scenes
import torch

from spiked.errors import ConfigurationError
from spiked.render import Camera, Rasteriser, cuda, reference
from spiked.sensor import Intrinsics, Mosaic

PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "colours")
needs_gpu = pytest.mark.skipif(cuda.missing() is not None, reason=f"no GPU here: {cuda.missing()}")


def camera() -> Camera:
    """Centred, where both renderers' limits of the slope agree."""
    return Camera(Intrinsics(40, 42, 22.5, 17.5), 45, 35)


def small_rasterisation(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    backgrounds: torch.Tensor,
    near_plane: float,
    **options: Any,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """What `gsplat.rasterization` promises, by the oracle's formulas."""
    assert options == {"eps2d": 0.3, "packed": False, "render_mode": "RGB+D"}
    seen = Camera(Intrinsics(*(float(Ks[0, i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))), width, height)
    images, alphas, radii = [], [], []
    for view, behind in zip(viewmats, backgrounds, strict=True):
        turn = view[:3, :3].T
        splats = reference.Parameters(
            *(x.double() for x in (means, quats, torch.log(scales), torch.logit(opacities), colors)),
            torch.zeros(1, 3),
            torch.zeros(1, 3),
        )
        pose = (turn.double(), (-turn @ view[:3, 3]).double())
        values, alpha, depth = reference.render_pose(splats, seen, pose, 0.0, near_plane)
        images.append(torch.cat([values + (1 - alpha)[:, :, None] * behind, depth[:, :, None]], 2))
        alphas.append(alpha[:, :, None])
        radii.append(torch.ones(len(means), 2))
    return torch.stack(images).float(), torch.stack(alphas).float(), {"radii": torch.stack(radii)}


def check(rasteriser: cuda.CudaRasteriser, *, moving: bool, mosaic: bool) -> None:
    """Images within 2e-3 and gradients within a hundredth of the CPU's."""
    seen = camera()
    rng = np.random.default_rng(2)
    splats = scenes.splats(120, 3, 2)
    splats.opacity_logits[:] = np.minimum(splats.opacity_logits, 4)
    rotations, centres = scenes.poses(3, 2, angle=0.01, shift=0.01)
    options: dict[str, Any] = {"background": 0.15, "channels": Mosaic.GRBG.channels(35, 45) if mosaic else None}
    windows = np.stack([np.zeros((35, 45)), np.full((35, 45), 2)]).astype(np.float32)
    weights = rng.uniform(0, 1, (3, 35, 45)).astype(np.float32)
    d_values = rng.normal(size=(35, 45) if mosaic else (35, 45, 3)).astype(np.float32)
    here = Rasteriser(seen, 1)
    if moving:
        expected = here.forward_moving(splats, rotations, centres, windows, **options)
        image = rasteriser.forward_moving(splats, rotations, centres, windows, **options)
    else:
        expected = here.forward(splats, rotations, centres, weights=weights, **options)
        image = rasteriser.forward(splats, rotations, centres, weights=weights, **options)
    # The CPU approximates what happens within a sub-frame by a blur, and splats here are wild.
    bound, slack = (0.03, 0.25) if moving else (2e-3, 1e-2)
    assert np.abs(image.values - expected.values).max() < bound
    assert np.abs(image.alpha - expected.alpha).max() < bound
    wanted, got = here.backward(d_values), rasteriser.backward(d_values)
    for name in (*PARAMETERS, "rotation", "centre", "contribution"):
        a, b = getattr(got, name), getattr(wanted, name)
        assert a.shape == b.shape
        assert np.linalg.norm(a - b) < slack * np.linalg.norm(b), name
    assert got.radius_px.shape == (120,)


@pytest.mark.parametrize("mosaic", [False, True])
@pytest.mark.parametrize("moving", [False, True])
def test_all_but_the_kernels_without_a_gpu(*, moving: bool, mosaic: bool) -> None:
    rasteriser = cuda.CudaRasteriser(camera(), device="cpu", rasterisation=small_rasterisation)
    check(rasteriser, moving=moving, mosaic=mosaic)


@needs_gpu
@pytest.mark.parametrize("mosaic", [False, True])
@pytest.mark.parametrize("moving", [False, True])
def test_same_results_as_the_cpu(*, moving: bool, mosaic: bool) -> None:
    check(cuda.CudaRasteriser(camera()), moving=moving, mosaic=mosaic)


@pytest.mark.skipif(cuda.missing() is None, reason="there is a GPU here")
def test_without_a_gpu_it_says_what_is_missing() -> None:
    with pytest.raises(ConfigurationError, match="GPU"):
        cuda.CudaRasteriser(camera())


def test_mistakes_are_told() -> None:
    rasteriser = cuda.CudaRasteriser(camera(), device="cpu", rasterisation=small_rasterisation)
    splats = scenes.splats(5, 1, 0)
    with pytest.raises(ConfigurationError, match="there was none"):
        rasteriser.backward(np.zeros((35, 45), np.float32))
    with pytest.raises(ConfigurationError, match="sub-poses are"):
        rasteriser.forward(splats, np.eye(3), np.zeros(3))
    with pytest.raises(ConfigurationError, match="windows are"):
        rasteriser.forward_moving(splats, [np.eye(3)] * 2, np.zeros((2, 3)), np.zeros((2, 2, 2), np.float32))
