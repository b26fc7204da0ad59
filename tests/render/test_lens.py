"""The CPU rasteriser through lenses with distortion, against the float64 oracle and a wide pinhole picture."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import render_scenes as scenes
import test_cpu
import test_moving
import torch

from spiked.distortion import Distortion, LensModel
from spiked.render import Camera, Rasteriser, rasteriser_for
from spiked.sensor import Intrinsics

LENSES = {
    "barrel": Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.004, -0.003, 0.01)),
    "pincushion": Distortion(LensModel.OPENCV, (0.25, 0.05)),
    "fisheye": Distortion(LensModel.FISHEYE, (0.03, -0.01, 0.004, -0.001)),
}


def bent(camera: Camera, lens: str) -> Camera:
    """The same camera behind a lens; a fisheye lens shows 110 degrees."""
    k, focal = camera.intrinsics, 0.6 if lens == "fisheye" else 1.0
    return replace(camera, intrinsics=Intrinsics(k.fx * focal, k.fy * focal, k.cx, k.cy, LENSES[lens]))


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("name", ["one", "mosaic of sub-poses"])
def test_images_and_gradients_match_the_oracle(name: str, lens: str) -> None:
    case = test_cpu.Case(name)
    case.camera = bent(case.camera, lens)
    rasteriser, image = case.forward()
    gradients = rasteriser.backward(case.d_values)
    parameters, (values, alpha, depth) = case.oracle()
    for mine, oracle in ((image.values, values), (image.alpha, alpha), (image.depth, depth)):
        assert np.abs(mine - oracle.detach().numpy()).max() < 1e-4
    (values * torch.tensor(case.d_values, dtype=torch.float64)).sum().backward()
    errors = {
        field: test_cpu.relative(getattr(gradients, field), getattr(parameters, field).grad.numpy())
        for field in test_cpu.PARAMETERS
    }
    errors["rotation"] = test_cpu.relative(gradients.rotation, parameters.turns.grad.numpy())
    errors["centre"] = test_cpu.relative(gradients.centre, parameters.centres.grad.numpy())
    assert max(errors.values()) < 2e-4, errors


@pytest.mark.parametrize("lens", LENSES)
def test_moving_cameras_match_the_oracle(lens: str) -> None:
    case = test_moving.Case("three colours", sub_frames=2)
    case.camera = bent(case.camera, lens)
    _, image, gradients = test_moving.errors(case)
    assert image < 1e-4
    assert max(gradients.values()) < 2e-4, gradients


@pytest.mark.parametrize("lens", LENSES)
def test_a_picture_is_the_wide_one_resampled(lens: str) -> None:
    camera = bent(scenes.camera(160, 120, 140.0), lens)
    splats = scenes.splats(400, 1, 2, 0.03)
    splats.means[:, 2] = np.abs(splats.means[:, 2])
    k, pose = camera.intrinsics, (np.eye(3)[None], np.zeros((1, 3)))
    fine = Camera(Intrinsics(4 * k.fx, 4 * k.fy, 800.0, 600.0), 1600, 1200)
    wide = Rasteriser(fine).forward(splats, *pose).values
    y, x = np.mgrid[0:120, 0:160] + 0.5
    at = (fine.intrinsics.project(k.unproject(np.stack([x, y], -1))) - 0.5).astype(np.float32)
    inside = ((at > 8) & (at < [1592, 1192])).all(-1)
    expected = cv2.remap(cv2.GaussianBlur(wide, (0, 0), 4 * 0.5), at, None, cv2.INTER_LINEAR)
    seen = Rasteriser(camera).forward(splats, *pose).values
    error = np.abs(seen - expected)[inside]
    plain = Rasteriser(Camera(k.pinhole, 160, 120)).forward(splats, *pose).values
    assert inside.mean() > 0.5
    assert error.mean() < 0.15 * np.abs(plain - expected)[inside].mean()


def test_splats_beyond_the_reach_of_a_lens_are_not_folded_back() -> None:
    folding = Distortion(LensModel.OPENCV, (-0.3,))
    camera = Camera(Intrinsics(40.0, 40.0, 24.0, 16.0, folding), 48, 32)
    splats = scenes.splats(1, 1, 1, 0.2)
    for slope in (1.5, 1.8, 2.2):  # the polynomial is 0 at 1.83
        splats.means[:] = [slope, 0, 1]
        image = Rasteriser(camera).forward(splats, np.eye(3)[None], np.zeros((1, 3)))
        assert (image.values == 0).all(), slope


def test_the_cpu_renders_images_with_distortion() -> None:
    assert isinstance(rasteriser_for(bent(scenes.camera(), "barrel")), Rasteriser)


@pytest.mark.parametrize("lens", LENSES)
def test_thin_splats_are_as_thick_as_without_the_lens(lens: str) -> None:
    """But for a sixth, the added blur is that of a pinhole camera's picture, bent with it."""
    camera = bent(scenes.camera(160, 120, 140.0), lens)
    splats = scenes.splats(400, 1, 2, 1e-3)
    splats.means[:, 2] = np.abs(splats.means[:, 2])
    k, pose = camera.intrinsics, (np.eye(3)[None], np.zeros((1, 3)))
    y, x = np.mgrid[0:120, 0:160] + 0.5
    at = k.unproject(np.stack([x, y], -1))
    wide = Camera(Intrinsics(k.fx, k.fy, 200.0, 150.0), 400, 300)
    plain = Rasteriser(wide).forward(splats, *pose).values
    places = (wide.intrinsics.project(at) - 0.5).astype(np.float32)
    radius = np.hypot(x - 80, y - 60)
    outer = ((places > 2) & (places < [397, 297])).all(-1) & (radius > 60)
    expected = cv2.remap(plain, places, None, cv2.INTER_LINEAR)[outer]
    seen = Rasteriser(camera).forward(splats, *pose).values[outer]
    # With all of the blur in the picture of the lens it would be 3 for the fisheye.
    assert abs(seen.sum() / expected.sum() - 1) < (0.4 if lens == "fisheye" else 0.1)
