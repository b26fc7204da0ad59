"""Distortion of a lens, against OpenCV's own functions."""

import cv2
import numpy as np
import pytest

from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError
from spiked.sensor import Intrinsics

BARREL = Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.002, -0.001, 0.01))
WIDE = Distortion(LensModel.FISHEYE, (0.05, -0.01, 0.002, -0.001))
LENSES = [BARREL, Distortion(LensModel.OPENCV, (0.2, -0.05)), WIDE, Distortion(LensModel.FISHEYE, ())]


def points(distortion: Distortion, count: int = 500) -> np.ndarray:
    """Points in front of a camera, for a fisheye lens up to 77 degrees from its axis."""
    wide = 3.0 if distortion.model is LensModel.FISHEYE else 0.6
    slopes = np.random.default_rng(1).uniform(-wide, wide, (count, 2))
    return np.concatenate([slopes, np.ones((count, 1))], 1) * np.random.default_rng(2).uniform(0.5, 3, (count, 1))


@pytest.mark.parametrize("distortion", LENSES, ids=str)
def test_pixels_are_those_of_opencv(distortion: Distortion) -> None:
    k, at = Intrinsics(300.0, 310.0, 200.0, 120.0, distortion), points(distortion)
    coefficients = np.array(distortion.coefficients).reshape(-1, 1)
    project = cv2.projectPoints if distortion.model is LensModel.OPENCV else cv2.fisheye.projectPoints
    zero = np.zeros((3, 1))
    expected = project(at[:, None], zero, zero, k.matrix(), coefficients)[0]
    assert np.abs(k.project(at) - expected[:, 0]).max() < 1e-9


@pytest.mark.parametrize("distortion", LENSES, ids=str)
def test_a_pixel_leads_back_to_its_ray(distortion: Distortion) -> None:
    k, at = Intrinsics(300.0, 310.0, 200.0, 120.0, distortion), points(distortion)
    rays = at / at[:, 2:]
    assert np.abs(k.unproject(k.project(at)) - rays).max() < 1e-9
    assert np.abs(k.pinhole.project(rays) - k.undistorted(k.project(at))).max() < 1e-7
    assert np.abs(k.distorted(k.pinhole.project(rays)) - k.project(at)).max() < 1e-7


@pytest.mark.parametrize("distortion", LENSES, ids=str)
def test_the_derivative_is_that_of_the_bent_slopes(distortion: Distortion) -> None:
    at = points(distortion)
    slopes, small = at[:, :2] / at[:, 2:], 1e-6
    step = small * np.eye(2)
    numeric = np.stack([(distortion.bend(slopes + e) - distortion.bend(slopes - e)) / (2 * small) for e in step], -1)
    assert np.abs(distortion.derivative(slopes) - numeric).max() < 1e-8


@pytest.mark.parametrize("distortion", LENSES, ids=str)
def test_k1_and_k2_move_bent_slopes_as_their_derivative_says(distortion: Distortion) -> None:
    at, step = points(distortion), 1e-6
    slopes = at[:, :2] / at[:, 2:]
    slopes = slopes[np.linalg.norm(slopes, axis=1) < 0.9 * distortion.reach]
    for number in range(2):
        moved = np.array(distortion.coefficients)
        moved[number] += step
        difference = (Distortion(distortion.model, tuple(moved)).bend(slopes) - distortion.bend(slopes)) / step
        np.testing.assert_allclose(distortion.by_radial(slopes)[..., number], difference, atol=1e-5)


def test_a_lens_is_said_by_the_other_model() -> None:
    mild, slopes = Distortion(LensModel.OPENCV, (-0.1, 0.02)), np.stack([np.linspace(0, 0.7, 50)] * 2, -1) / np.sqrt(2)
    fisheye = mild.as_model(LensModel.FISHEYE, 0.7)
    assert fisheye.model is LensModel.FISHEYE
    assert np.abs(fisheye.bend(slopes) - mild.bend(slopes)).max() < 1e-4
    back = fisheye.as_model(LensModel.OPENCV, 0.7)
    assert back.coefficients[:2] == pytest.approx(mild.coefficients[:2], abs=5e-3)


def test_slopes_beyond_the_fold_are_not_imaged_again() -> None:
    folding = Distortion(LensModel.OPENCV, (-0.3,))
    assert folding.reach == pytest.approx(np.sqrt(1 / 0.9), abs=2e-3)  # where 1 + 3 k1 r^2 = 0
    k = Intrinsics(300.0, 300.0, 200.0, 120.0, folding)
    far = k.project(np.array([[5.0, 0.0, 1.0]]))[0, 0]
    assert far == pytest.approx(k.project(np.array([[folding.reach, 0.0, 1.0]]))[0, 0])
    beyond = k.unproject(np.array([[4000.0, 120.0]]))
    assert beyond[0, 0] == pytest.approx(folding.reach, rel=1e-3)


def test_without_distortion_nothing_is_computed() -> None:
    k, pixels = Intrinsics(300.0, 310.0, 200.0, 120.0), np.ones((3, 2))
    assert k.undistorted(pixels) is pixels and k.distorted(pixels) is pixels and k.pinhole is k and k.lens() == {}


@pytest.mark.parametrize(
    ("model", "coefficients", "said"),
    [
        (LensModel.FISHEYE, (0.1,) * 5, "the fisheye model has k1, k2, k3, k4"),
        (LensModel.OPENCV, (np.nan,), "finite"),
        (LensModel.OPENCV, (-0.3, 1e9), "at most 1000"),
        (LensModel.OPENCV, (-1000.0,), "folds the image .* check the order, k1, k2, p1, p2, k3"),
        (LensModel.FISHEYE, (-1000.0,), "folds the image"),
    ],
)
def test_coefficients_of_no_lens_are_refused(model: LensModel, coefficients: tuple[float, ...], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Distortion(model, coefficients)


def test_names_of_the_other_model_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="the fisheye model has no p1"):
        Distortion.of(LensModel.FISHEYE, {"k1": 0.1, "p1": 0.1})
    assert Distortion.of(LensModel.OPENCV, {"k3": 0.1}).coefficients == (0, 0, 0, 0, 0.1)
