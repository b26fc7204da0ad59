"""The CPU rasteriser against the float64 oracle, finite differences, and itself."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import render_scenes as scenes
import torch

from spiked import render
from spiked.errors import ConfigurationError
from spiked.render import Camera, Gradients, Rasteriser, RenderedImage, reference
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Mosaic

PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "colours")
BACKGROUND = 0.15
Figure = Callable[[str, object, str], None]


class Case:
    """One scene with its sub-poses, weights, mosaic and a random gradient of the image."""

    def __init__(self, name: str, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.camera = scenes.camera()
        size = (self.camera.height, self.camera.width)
        many = name in ("sub-poses", "mosaic of sub-poses")
        self.splats = scenes.splats(120, 1 if name in ("one", "sub-poses") else 3, seed)
        self.rotations, self.centres = scenes.poses(4 if many else 1, seed)
        self.weights = rng.uniform(0, 2, (4, *size)).astype(np.float32) if many else None
        self.channels = Mosaic.GRBG.channels(*size) if "mosaic" in name else None
        values = size if name != "three colours" else (*size, 3)
        self.d_values = rng.normal(size=values).astype(np.float32)

    def forward(self, threads: int = 1) -> tuple[Rasteriser, RenderedImage]:
        rasteriser = Rasteriser(self.camera, threads)
        image = rasteriser.forward(
            self.splats,
            self.rotations,
            self.centres,
            weights=self.weights,
            channels=self.channels,
            background=BACKGROUND,
        )
        return rasteriser, image

    def oracle(self) -> tuple[reference.Parameters, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        parameters = reference.Parameters.of(self.splats, self.centres)
        images = reference.render(
            parameters,
            self.camera,
            self.rotations,
            weights=self.weights,
            channels=self.channels,
            background=BACKGROUND,
        )
        return parameters, images


CASES = ("one", "three colours", "mosaic", "sub-poses", "mosaic of sub-poses")


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    assert np.linalg.norm(expected) > 0
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("name", CASES)
def test_images_match_the_oracle(name: str) -> None:
    case = Case(name)
    _, image = case.forward()
    _, (values, alpha, depth) = case.oracle()
    assert np.abs(image.values - values.detach().numpy()).max() < 1e-4
    assert np.abs(image.alpha - alpha.detach().numpy()).max() < 1e-4
    assert np.abs(image.depth - depth.detach().numpy()).max() < 1e-4


@pytest.mark.validation
@pytest.mark.parametrize("name", CASES)
def test_gradients_match_the_oracle(name: str, figure: Figure) -> None:
    case = Case(name)
    rasteriser, _ = case.forward()
    gradients = rasteriser.backward(case.d_values)
    parameters, (values, _, _) = case.oracle()
    (values * torch.tensor(case.d_values, dtype=torch.float64)).sum().backward()
    errors = {
        field: relative(getattr(gradients, field), getattr(parameters, field).grad.numpy()) for field in PARAMETERS
    }
    errors["rotation"] = relative(gradients.rotation, parameters.turns.grad.numpy())
    errors["centre"] = relative(gradients.centre, parameters.centres.grad.numpy())
    figure(f"gradients, {name}: worst relative error", f"{max(errors.values()):.1e}", "< 1e-4")
    assert max(errors.values()) < 1e-4, errors


@pytest.mark.validation
@pytest.mark.parametrize("name", CASES)
def test_moving_the_camera_is_moving_the_scene_back(name: str, figure: Figure) -> None:
    case = Case(name, seed=5)
    rasteriser, _ = case.forward()
    gradients = rasteriser.backward(case.d_values)
    error = relative(gradients.centre.sum(0), -gradients.means.astype(np.float64).sum(0))
    figure(f"translation identity, {name}", f"{error:.1e}", "< 1e-5")
    assert error < 1e-5


def test_pixels_without_weight_are_black_and_move_nothing() -> None:
    case = Case("sub-poses")
    assert case.weights is not None
    case.weights[:, :, 20:] = 0
    case.d_values[:, :20] = 0
    rasteriser, image = case.forward()
    gradients = rasteriser.backward(case.d_values)
    for array in (image.values, image.alpha, image.depth):
        assert (array[:, 20:] == 0).all()
        assert (array[:, :20] != 0).any()
    for name in (*PARAMETERS, "rotation", "centre"):
        assert (getattr(gradients, name) == 0).all(), name


def test_pose_gradient_matches_finite_differences() -> None:
    """With splats so wide that no pixel is near their rims, where the cut at 1/255 makes the image jump."""
    case = Case("sub-poses", seed=3)
    case.splats = scenes.splats(10, 1, 3)
    case.splats.means[:] = np.stack([*np.random.default_rng(3).uniform(-0.5, 0.5, (2, 10)), np.linspace(1, 3, 10)], 1)
    case.splats.log_scales[:] = np.random.default_rng(4).uniform(-0.2, 0.4, (10, 3))
    case.splats.opacity_logits[:] = 0.5
    case.d_values = np.fromfunction(lambda y, x: np.sin(x / 8) + np.cos(y / 5), case.d_values.shape, dtype=np.float32)
    rasteriser, _ = case.forward()
    gradients = rasteriser.backward(case.d_values)

    def loss(turns: np.ndarray, shift: np.ndarray) -> float:
        rotations = np.stack([scenes.turn(t) @ r for t, r in zip(turns, case.rotations, strict=True)])
        image = rasteriser.forward(
            case.splats, rotations, case.centres + shift, weights=case.weights, background=BACKGROUND
        )
        return float((image.values.astype(np.float64) * case.d_values).sum())

    step = 1e-3
    numeric = np.zeros((2, 4, 3))
    for which in range(2):
        for index in np.ndindex(4, 3):
            change = np.zeros((2, 4, 3))
            change[(which, *index)] = step
            numeric[(which, *index)] = (loss(*change) - loss(*-change)) / (2 * step)
    assert relative(gradients.rotation, numeric[0]) < 1e-3
    assert relative(gradients.centre, numeric[1]) < 1e-3


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    case = Case("mosaic of sub-poses")
    case.splats = scenes.splats(3000, 3, 7, size=0.02)
    reference_bits: list[bytes] | None = None
    for threads in (1, 2, 3, 5):
        rasteriser, image = case.forward(threads)
        gradients = rasteriser.backward(case.d_values)
        arrays = [image.values, image.alpha, image.depth, *(getattr(gradients, f.name) for f in fields(Gradients))]
        bits = [array.tobytes() for array in arrays]
        reference_bits = reference_bits or bits
        assert bits == reference_bits


@pytest.mark.parametrize("level", ["avx512", "avx2", "baseline"])
def test_every_instruction_set_gives_the_same_picture(level: str) -> None:
    """In a process of its own: the level is chosen when the rasteriser is made, from the environment."""
    program = (
        "import sys, pathlib; sys.path.insert(0, sys.argv[1])\n"
        "import numpy as np, test_cpu\n"
        "case = test_cpu.Case('mosaic of sub-poses')\n"
        "r, image = case.forward()\n"
        "g = r.backward(case.d_values)\n"
        "parameters, (values, _, _) = case.oracle()\n"
        "(values * test_cpu.torch.tensor(case.d_values)).sum().backward()\n"
        "print(r.instructions, np.abs(image.values - values.detach().numpy()).max(),\n"
        "  max(test_cpu.relative(getattr(g, f), getattr(parameters, f).grad.numpy()) for f in test_cpu.PARAMETERS))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", program, str(Path(__file__).parent)],
        env={**os.environ, "SPIKED_SIMD": level},
        capture_output=True,
        text=True,
        check=False,
    )
    if "is not an instruction set of this machine" in run.stderr:
        pytest.skip(f"this machine has no {level}")
    assert run.returncode == 0, run.stderr
    name, image_error, gradient_error = run.stdout.split()
    assert name == level
    assert float(image_error) < 1e-4
    assert float(gradient_error) < 1e-4


def test_an_unknown_instruction_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_SIMD", "mmx")
    with pytest.raises(ConfigurationError, match="SPIKED_SIMD=mmx"):
        Rasteriser(scenes.camera(), 1)


@pytest.mark.parametrize(("width", "height"), [(400, 250), (16, 16), (17, 3), (1, 1), (33, 64)])
def test_any_size_of_image(width: int, height: int) -> None:
    camera = Camera(Intrinsics(0.9 * width, 0.9 * width, width / 2, height / 2), width, height)
    splats = scenes.splats(25, 1, 2)
    rotations, centres = scenes.poses(1, 2)
    image = Rasteriser(camera, 2).forward(splats, rotations, centres)
    values, _, _ = reference.render(reference.Parameters.of(splats, centres), camera, rotations)
    assert image.values.shape == (height, width)
    assert np.abs(image.values - values.detach().numpy()).max() < 1e-4


def one_splat(**changes: object) -> Scene:
    arrays = {
        "means": [[0, 0, 2]],
        "quats": [[1, 0, 0, 0]],
        "log_scales": [[-2, -2, -2]],
        "opacity_logits": [1],
        "colours": [[0.5]],
    } | changes
    return Scene(**{name: np.array(value, np.float32) for name, value in arrays.items()})


def test_former_names_of_the_splat_arrays_are_the_scene() -> None:
    assert render.Splats is render.SplatArrays is Scene


def test_an_empty_scene_is_background() -> None:
    camera = scenes.camera()
    empty = Scene(*(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 1))))
    rasteriser = Rasteriser(camera, 1)
    image = rasteriser.forward(empty, [np.eye(3)], [np.zeros(3)], background=0.25)
    assert (image.values == 0.25).all()
    assert (image.alpha == 0).all()
    assert (image.depth == 0).all()
    gradients = rasteriser.backward(np.ones_like(image.values))
    assert gradients.means.shape == (0, 3)
    assert (gradients.rotation == 0).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"means": [[0, 0, -2]]},
        {"means": [[0, 0, 0.005]]},
        {"means": [[0, 0, 0]]},
        {"means": [[500, 0, 2]]},
        {"means": [[np.nan, 0, 2]]},
        {"means": [[np.inf, 0, 2]]},
        {"log_scales": [[np.nan, 0, 0]], "means": [[0, 0, -1]]},
        {"quats": [[np.nan, 0, 0, 0]]},
        {"opacity_logits": [-6]},
        {"opacity_logits": [-200]},
    ],
    ids=str,
)
def test_a_splat_that_cannot_be_seen_leaves_no_trace(changes: dict[str, object]) -> None:
    rasteriser = Rasteriser(scenes.camera(), 1)
    image = rasteriser.forward(one_splat(**changes), [np.eye(3)], [np.zeros(3)], background=0.1)
    assert (image.values == np.float32(0.1)).all()
    gradients = rasteriser.backward(np.ones_like(image.values))
    for field in fields(Gradients):
        assert (getattr(gradients, field.name) == 0).all(), field.name


@pytest.mark.parametrize(
    "changes",
    [
        {"quats": [[0, 0, 0, 0]]},
        {"log_scales": [[-40, -40, -40]]},
        {"log_scales": [[8, -12, -12]], "quats": [[0.7, 0.1, 0.3, 0.2]]},
        {"log_scales": [[9, 9, 9]]},
        {"opacity_logits": [40]},
        {"means": [[3, 3, 0.011]], "log_scales": [[0, 0, 0]]},
        {"means": [[0, 0, 1e6]]},
    ],
    ids=str,
)
def test_extreme_splats_stay_finite(changes: dict[str, object]) -> None:
    rasteriser = Rasteriser(scenes.camera(), 1)
    image = rasteriser.forward(one_splat(**changes), [np.eye(3)], [np.zeros(3)])
    gradients = rasteriser.backward(np.ones_like(image.values))
    assert np.isfinite(image.values).all()
    assert np.isfinite(image.depth).all()
    for field in fields(Gradients):
        assert np.isfinite(getattr(gradients, field.name)).all(), field.name


def test_an_opaque_pile_hides_what_is_behind() -> None:
    """Through the early stop: sixty opaque layers in front of a bright one."""
    depths = np.linspace(1, 2, 61)
    layers = Scene(
        np.stack([0 * depths, 0 * depths, depths], 1).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (61, 1)),
        np.full((61, 3), 1.0, np.float32),
        np.full(61, 3.0, np.float32),
        np.r_[np.full(60, 0.3), 100.0].astype(np.float32)[:, None],
    )
    rasteriser = Rasteriser(scenes.camera(), 1)
    image = rasteriser.forward(layers, [np.eye(3)], [np.zeros(3)])
    assert np.abs(image.values - 0.3).max() < 1e-3
    gradients = rasteriser.backward(np.ones_like(image.values))
    assert gradients.contribution[0] > 1000
    assert gradients.contribution[-1] == 0


def test_contribution_and_radius_are_what_they_say() -> None:
    case = Case("one")
    rasteriser, image = case.forward()
    gradients = rasteriser.backward(case.d_values)
    assert gradients.contribution.sum() == pytest.approx(float(image.alpha.sum()), rel=1e-4)
    splat = one_splat()
    rasteriser.forward(splat, [np.eye(3)], [np.zeros(3)])
    k = case.camera.intrinsics
    sigma2 = (np.exp(-2) * k.fy / 2) ** 2 + 0.3
    expected = np.sqrt(2 * np.log(255 / (1 + np.exp(-1))) * sigma2)
    assert rasteriser.backward(case.d_values).radius_px[0] == pytest.approx(expected, rel=1e-4)


def test_mistakes_are_told() -> None:
    camera = scenes.camera()
    rasteriser = Rasteriser(camera, 1)
    splats = scenes.splats(5, 1, 0)
    with pytest.raises(ConfigurationError, match="there was none"):
        rasteriser.backward(np.zeros((camera.height, camera.width), np.float32))
    with pytest.raises(ConfigurationError, match="sub-poses are"):
        rasteriser.forward(splats, np.eye(3), np.zeros(3))
    with pytest.raises(ConfigurationError, match="weights are"):
        rasteriser.forward(splats, [np.eye(3)], [np.zeros(3)], weights=np.ones((1, 2, 3), np.float32))
    with pytest.raises(ConfigurationError, match="three colours"):
        rasteriser.forward(splats, [np.eye(3)], [np.zeros(3)], channels=Mosaic.RGGB.channels(35, 45))
    colour, size = scenes.splats(5, 3, 0), (camera.height, camera.width)
    for channels in (np.full(size, 256), np.full(size, -1), np.full(size, 1.7)):  # bytes of them would be 0, 255 and 1
        with pytest.raises(ConfigurationError, match="whole channels 0 to 2"):
            rasteriser.forward(colour, [np.eye(3)], [np.zeros(3)], channels=channels)
    with pytest.raises(ConfigurationError, match="a background is"):
        rasteriser.forward(colour, [np.eye(3)], [np.zeros(3)], background=(0.0, 1.0))
    with pytest.raises(ConfigurationError, match="not finite"):
        rasteriser.forward(splats, [np.full((3, 3), np.nan)], [np.zeros(3)])
    rasteriser.forward(splats, [np.eye(3)], [np.zeros(3)])
    with pytest.raises(ConfigurationError, match="as rendered"):
        rasteriser.backward(np.zeros((3, 3), np.float32))
    with pytest.raises(ConfigurationError, match="threads"):
        Rasteriser(camera, 0)


def test_the_cpu_path_does_not_import_torch() -> None:
    program = "import sys, spiked.render, spiked.render.cpu; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
