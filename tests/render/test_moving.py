"""Renders from a camera on its way: against the oracle, finite differences, and exact renders of many instants."""

import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import render_scenes as scenes
import torch

from spiked.errors import ConfigurationError
from spiked.pose import exp_so3
from spiked.render import Camera, Gradients, Rasteriser, RenderedImage, reference
from spiked.sensor import Intrinsics, Mosaic

PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "colours")
BACKGROUND = 0.15


class Case:
    """A camera that passes three or more poses, with a window of its own for each pixel."""

    def __init__(self, name: str, seed: int = 1, sub_frames: int = 2) -> None:
        rng = np.random.default_rng(seed)
        self.camera = scenes.camera()
        size = (self.camera.height, self.camera.width)
        self.splats = scenes.splats(120, 1 if name == "one" else 3, seed)
        self.rotations, self.centres = scenes.poses(sub_frames + 1, seed, angle=0.02, shift=0.02)
        self.windows = np.sort(rng.uniform(-0.2, sub_frames + 0.2, (2, *size)), 0).astype(np.float32)
        self.channels = Mosaic.GRBG.channels(*size) if name == "mosaic" else None
        self.d_values = rng.normal(size=size if name != "three colours" else (*size, 3)).astype(np.float32)

    def forward(self, threads: int = 1) -> tuple[Rasteriser, RenderedImage]:
        rasteriser = Rasteriser(self.camera, threads)
        image = rasteriser.forward_moving(
            self.splats,
            self.rotations,
            self.centres,
            self.windows,
            channels=self.channels,
            background=BACKGROUND,
        )
        return rasteriser, image

    def oracle(self) -> tuple[reference.Parameters, torch.Tensor]:
        parameters = reference.Parameters.of(self.splats, self.centres)
        values = reference.render_moving(
            parameters, self.camera, self.rotations, self.windows, channels=self.channels, background=BACKGROUND
        )
        return parameters, values


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    assert np.linalg.norm(expected) > 0
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


def errors(case: Case) -> tuple[str, float, dict[str, float]]:
    """The instruction set, the largest error of the image, and the relative errors of the gradients."""
    rasteriser, image = case.forward()
    gradients = rasteriser.backward(case.d_values)
    parameters, values = case.oracle()
    (values * torch.tensor(case.d_values, dtype=torch.float64)).sum().backward()
    parts = {
        field: relative(getattr(gradients, field), getattr(parameters, field).grad.numpy()) for field in PARAMETERS
    }
    parts["rotation"] = relative(gradients.rotation, parameters.turns.grad.numpy())
    parts["centre"] = relative(gradients.centre, parameters.centres.grad.numpy())
    return rasteriser.instructions, float(np.abs(image.values - values.detach().numpy()).max()), parts


@pytest.mark.parametrize("name", ["one", "three colours", "mosaic"])
@pytest.mark.parametrize("sub_frames", [1, 3])
def test_images_and_gradients_match_the_oracle(name: str, sub_frames: int) -> None:
    _, image, gradients = errors(Case(name, sub_frames=sub_frames))
    assert image < 1e-4
    assert max(gradients.values()) < 1e-4, gradients


@pytest.mark.parametrize("level", ["avx512", "avx2", "baseline"])
def test_every_instruction_set_gives_the_same_picture(level: str) -> None:
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import test_moving\n"
        "name, image, parts = test_moving.errors(test_moving.Case('mosaic'))\n"
        "print(name, image, max(parts.values()))\n"
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


def test_a_camera_that_does_not_move_sees_what_a_still_one_sees() -> None:
    case = Case("one")
    case.rotations[:] = case.rotations[0]
    case.centres[:] = case.centres[0]
    case.windows[0], case.windows[1] = 0, 2
    rasteriser, moving = case.forward()
    moving_gradients = rasteriser.backward(case.d_values)
    still = rasteriser.forward(case.splats, case.rotations[:1], case.centres[:1], background=BACKGROUND)
    still_gradients = rasteriser.backward(case.d_values)
    for field in fields(RenderedImage):
        assert relative(getattr(moving, field.name), getattr(still, field.name)) < 1e-5
    for name in PARAMETERS:
        assert relative(getattr(moving_gradients, name), getattr(still_gradients, name)) < 1e-4
    assert relative(moving_gradients.centre.sum(0), still_gradients.centre[0]) < 1e-4
    assert relative(moving_gradients.rotation.sum(0), still_gradients.rotation[0]) < 1e-4


def test_moving_the_camera_is_moving_the_scene_back() -> None:
    case = Case("mosaic", seed=5)
    rasteriser, _ = case.forward()
    gradients = rasteriser.backward(case.d_values)
    assert relative(gradients.centre.sum(0), -gradients.means.astype(np.float64).sum(0)) < 1e-5


def test_pixels_that_do_not_look_are_black_and_move_nothing() -> None:
    case = Case("one")
    case.windows[:, :, 20:] = 1.0
    case.d_values[:, :20] = 0
    rasteriser, image = case.forward()
    gradients = rasteriser.backward(case.d_values)
    for array in (image.values, image.alpha, image.depth):
        assert (array[:, 20:] == 0).all()
        assert (array[:, :20] != 0).any()
    for name in (*PARAMETERS, "rotation", "centre"):
        assert (getattr(gradients, name) == 0).all(), name


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    case = Case("mosaic", sub_frames=3)
    case.splats = scenes.splats(3000, 3, 7, size=0.02)
    reference_bits: list[bytes] | None = None
    for threads in (1, 2, 3, 5):
        rasteriser, image = case.forward(threads)
        gradients = rasteriser.backward(case.d_values)
        arrays = [image.values, image.alpha, image.depth, *(getattr(gradients, f.name) for f in fields(Gradients))]
        bits = [array.tobytes() for array in arrays]
        reference_bits = reference_bits or bits
        assert bits == reference_bits


def camera_motion(camera: Camera, motion_px: float, poses: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a camera that turns and shifts so that the image moves by about `motion_px`, mostly to one side."""
    times = np.linspace(-0.5, 0.5, poses)
    angle = motion_px / camera.intrinsics.fx
    rotations = np.stack([exp_so3(np.array([-0.5, 0.8, 0.2]) * angle * t) for t in times])
    return rotations, np.outer(times, [0.3, 0.2, 0.1]) * angle


@pytest.mark.parametrize(("sub_frames", "bound"), [(1, 0.06), (2, 0.018), (4, 0.006)])
def test_few_sub_frames_are_close_to_many_exact_renders(sub_frames: int, bound: float) -> None:
    """Two pixels of motion; the error as a share of the contrast. Standing still: more than a tenth."""
    camera = Camera(Intrinsics(80, 80, 48, 32), 96, 64)
    splats = scenes.splats(5000, 1, 3, size=0.015)
    rng = np.random.default_rng(0)
    start = rng.uniform(0, 0.3, (64, 96)).astype(np.float32)
    stop = rng.uniform(0.7, 1, (64, 96)).astype(np.float32)
    many = 64
    rotations, centres = camera_motion(camera, 2.0, many + 1)
    edges = np.arange(many + 1)[:, None, None] / many
    overlap = np.clip(np.minimum(stop, edges[1:]) - np.maximum(start, edges[:-1]), 0, None)
    rasteriser = Rasteriser(camera, 1)
    middle_rotations, middle_centres = camera_motion(camera, 2.0, 2 * many + 1)
    exact = rasteriser.forward(
        splats,
        middle_rotations[1::2],
        middle_centres[1::2],
        weights=(overlap / (stop - start)).astype(np.float32),
    ).values
    rotations, centres = camera_motion(camera, 2.0, sub_frames + 1)
    windows = np.stack([start, stop]) * np.float32(sub_frames)
    image = rasteriser.forward_moving(splats, rotations, centres, windows).values
    inner = (slice(4, -4), slice(4, -4))
    error = float(np.std(image[inner] - exact[inner]) / np.std(exact[inner]))
    still = rasteriser.forward(splats, np.eye(3)[None], np.zeros((1, 3))).values
    assert error < bound
    assert np.std(still[inner] - exact[inner]) / np.std(exact[inner]) > 0.1


def test_mistakes_are_told() -> None:
    case = Case("one")
    rasteriser = Rasteriser(case.camera, 1)
    with pytest.raises(ConfigurationError, match="windows are"):
        rasteriser.forward_moving(case.splats, case.rotations, case.centres, case.windows[:, :3])
    with pytest.raises(ConfigurationError, match="two poses"):
        rasteriser.forward_moving(case.splats, case.rotations[:1], case.centres[:1], case.windows)
    with pytest.raises(ConfigurationError, match="not finite"):
        rasteriser.forward_moving(case.splats, case.rotations, case.centres, np.full_like(case.windows, np.nan))
