"""Our kernels against those of gsplat, where a GPU and gsplat (pip install gsplat) are there."""

import numpy as np
import pytest
import render_scenes as scenes
import torch

from spiked.render import Camera, gpu
from spiked.scene import Scene
from spiked.sensor import Intrinsics

gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed")
pytestmark = pytest.mark.skipif(gpu.missing() is not None, reason=f"no GPU here: {gpu.missing()}")


@pytest.mark.parametrize("colours", [1, 3])
def test_images_and_gradients_are_those_of_gsplat(colours: int) -> None:
    """Below the caps of opacity, which differ (0.99 here, 0.999 there)."""
    camera = Camera(Intrinsics(80, 84, 45.0, 35.0), 90, 70)
    splats = scenes.splats(500, colours, 4)
    splats = Scene(*splats.arrays()[:3], np.minimum(splats.opacity_logits, 2), splats.colours)
    rotations, centres = scenes.poses(1, 4)
    ours = gpu.GpuRasteriser(camera)
    image = ours.forward(splats, rotations, centres)
    d_values = np.random.default_rng(1).normal(size=image.values.shape).astype(np.float32)
    gradients = ours.backward(d_values)

    leaves = [torch.tensor(array, device="cuda", requires_grad=True) for array in splats.arrays()]
    means, quats, log_scales, logits, colour = leaves
    view = np.eye(4)
    view[:3, :3] = rotations[0].T
    view[:3, 3] = -rotations[0].T @ centres[0]
    k = camera.intrinsics
    matrix = [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]]
    values, _, _ = gsplat.rasterization(
        means, quats, log_scales.exp(), logits.sigmoid(), colour,
        torch.tensor(view[None], dtype=torch.float32, device="cuda"),
        torch.tensor([matrix], dtype=torch.float32, device="cuda"),
        camera.width, camera.height, near_plane=0.01, eps2d=0.3, packed=False,
    )  # fmt: skip
    theirs = values[0] if colours == 3 else values[0, :, :, 0]
    assert np.abs(theirs.detach().cpu().numpy() - image.values).max() < 2e-3
    (theirs * torch.tensor(d_values, device="cuda")).sum().backward()
    for leaf, mine in zip(leaves, gradients.arrays(), strict=True):
        assert leaf.grad is not None
        other = leaf.grad.cpu().numpy()
        assert np.linalg.norm(mine - other) < 1e-2 * np.linalg.norm(other)
