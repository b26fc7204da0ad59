"""The operators of torch against the rasteriser and losses that they stand for, and as torch checks operators."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import render_scenes
import torch
from torch import Tensor

from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError, SceneError
from spiked.render import Camera, Rasteriser, gpu
from spiked.render import torch as operators
from spiked.render.charge import WARP_CELL_PX, ChargeLoss
from spiked.render.loss import dssim
from spiked.scene import Scene
from spiked.sensor import Mosaic, Sensor

ROOT = Path(__file__).parents[2]
CAMERA = render_scenes.camera()
SIZE = CAMERA.height, CAMERA.width


class Case:
    """A render with everything that it may have."""

    def __init__(self, kind: str) -> None:
        rng = np.random.default_rng(0)
        self.camera = CAMERA
        if kind == "lens":
            bent = Distortion(LensModel.OPENCV, (-0.2, 0.05))
            self.camera = Camera(replace(CAMERA.intrinsics, distortion=bent), *reversed(SIZE))
        self.scene = render_scenes.splats(60, 1 if kind == "grey" else 3, 0)
        self.rotations, self.centres = render_scenes.poses(3, 0)
        self.weights = rng.uniform(0, 1, (3, *SIZE)).astype(np.float32) if kind == "weights" else None
        self.windows = None
        if kind in ("moving", "mosaic"):
            begin = rng.uniform(0, 1, SIZE)
            self.windows = np.stack([begin, begin + rng.uniform(0, 1, SIZE)]).astype(np.float32)
        self.channels = Mosaic.RGGB.channels(*SIZE) if kind == "mosaic" else None
        self.background = 0.3 if kind == "grey" else (0.1, 0.2, 0.3)

    def leaves(self, dtype: torch.dtype = torch.float32) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Splats, rotations and centres that have gradients."""
        splats = {name: t.to(dtype).requires_grad_() for name, t in self.scene.to_torch().items()}
        poses = (torch.tensor(array, requires_grad=True) for array in (self.rotations, self.centres))
        return splats, *poses

    def render(self, splats: dict[str, Tensor], rotations: Tensor, centres: Tensor) -> operators.Rendered:
        fixed = {"weights": self.weights, "windows": self.windows, "channels": self.channels}
        tensors = {name: torch.from_numpy(array) for name, array in fixed.items() if array is not None}
        return operators.render(self.camera, splats, rotations, centres, background=self.background, **tensors)  # type: ignore[arg-type]

    def expected(self, slope: Callable[[np.ndarray], np.ndarray]) -> tuple[Any, Any]:
        """Image and gradients by the rasteriser itself."""
        rasteriser = Rasteriser(self.camera)
        other: dict[str, Any] = {"channels": self.channels, "background": self.background}
        if self.windows is not None:
            image = rasteriser.forward_moving(self.scene, self.rotations, self.centres, self.windows, **other)
        else:
            image = rasteriser.forward(self.scene, self.rotations, self.centres, weights=self.weights, **other)
        return image, rasteriser.backward(slope(image.values))


@pytest.mark.parametrize("kind", ["grey", "colour", "weights", "moving", "mosaic", "lens"])
def test_image_and_gradients_are_those_of_the_rasteriser(kind: str) -> None:
    case = Case(kind)
    splats, rotations, centres = case.leaves()
    made = case.render(splats, rotations, centres)
    image, gradients = case.expected(lambda values: 2 * values)
    assert [np.array_equal(a.detach().numpy(), b) for a, b in zip(made, vars(image).values(), strict=True)] == [
        True
    ] * 3
    assert not made.alpha.requires_grad and not made.depth.requires_grad
    made.values.square().sum().backward()
    for tensor, by in zip([*splats.values(), centres], [*gradients.arrays(), gradients.centre], strict=True):
        assert tensor.grad is not None
        np.testing.assert_array_equal(tensor.grad.numpy(), by)


@pytest.mark.skipif(gpu.missing() is not None, reason=f"no GPU here: {gpu.missing()}")
@pytest.mark.parametrize("kind", ["grey", "weights", "mosaic", "lens"])
def test_tensors_on_a_gpu_are_rendered_there(kind: str) -> None:
    case = Case(kind)
    splats, rotations, centres = case.leaves()
    here = {name: t.detach().cuda().requires_grad_() for name, t in splats.items()}
    turned, places = (t.detach().cuda().requires_grad_() for t in (rotations, centres))
    fixed = {"weights": case.weights, "windows": case.windows, "channels": case.channels}
    tensors: dict[str, Any] = {
        name: torch.from_numpy(array).cuda() for name, array in fixed.items() if array is not None
    }
    made = operators.render(case.camera, here, turned, places, background=case.background, **tensors)
    expected = case.render(splats, rotations, centres)
    for mine, other in zip(made, expected, strict=True):
        assert mine.is_cuda
        assert torch.allclose(mine.cpu(), other, atol=2e-4)
    made.values.square().sum().backward()
    expected.values.square().sum().backward()
    for mine, other in zip([*here.values(), turned, places], [*splats.values(), rotations, centres], strict=True):
        assert mine.grad is not None and other.grad is not None and mine.grad.is_cuda
        assert float((mine.grad.cpu() - other.grad).norm()) < 2e-4 * float(other.grad.norm())
    torch.library.opcheck(operators._render, _arguments(case, here, turned, places, tensors))


def _arguments(case: Case, splats: dict[str, Tensor], rotations: Tensor, centres: Tensor, more: dict[str, Any]) -> Any:
    ground = [case.background] if isinstance(case.background, float) else [*case.background]
    planes = [more.get(name) for name in ("weights", "windows", "channels")]
    size = case.camera.width, case.camera.height
    return *splats.values(), rotations, centres, *planes, ground, operators._optics(case.camera), *size, 0.01


def test_a_rotation_carries_the_gradient_of_what_turns_it() -> None:
    case = Case("weights")
    splats, rotations, centres = case.leaves()
    turns = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    x, y, z = turns.T
    zero = torch.zeros_like(x)
    crosses = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    case.render(splats, torch.linalg.matrix_exp(crosses) @ rotations, centres).values.square().sum().backward()
    _, gradients = case.expected(lambda values: 2 * values)
    assert turns.grad is not None
    np.testing.assert_allclose(turns.grad.numpy(), gradients.rotation, rtol=1e-9)


def test_gradients_of_splats_agree_with_finite_differences() -> None:
    case = Case("colour")
    case.scene = render_scenes.splats(3, 3, 1, size=0.3)
    splats, rotations, centres = case.leaves(torch.float64)

    def loss(*given: Tensor) -> Tensor:
        made = case.render(dict(zip(splats, given, strict=True)), rotations.detach(), centres.detach())
        return made.values.double().square().mean()

    # Splats end where their alpha is below 1/255, so differences have steps.
    assert torch.autograd.gradcheck(loss, tuple(splats.values()), eps=1e-2, atol=2e-3, rtol=0.05)


def test_a_render_between_forward_and_backward_changes_no_gradient() -> None:
    case = Case("colour")
    alone, *_ = case.leaves()
    splats, rotations, centres = case.leaves()
    case.render(alone, rotations, centres).values.square().sum().backward()
    first = case.render(splats, rotations, centres)
    with torch.inference_mode():
        case.render({name: t.clone() for name, t in splats.items()}, rotations, centres + 0.1)
    first.values.square().sum().backward()
    for name, tensor in splats.items():
        torch.testing.assert_close(tensor.grad, alone[name].grad, rtol=0, atol=0)


def test_gradients_come_back_in_the_type_of_the_tensors() -> None:
    splats, rotations, centres = Case("colour").leaves(torch.float64)
    Case("colour").render(splats, rotations.float().detach().requires_grad_(), centres).values.sum().backward()
    assert {t.grad.dtype for t in splats.values() if t.grad is not None} == {torch.float64}


@pytest.mark.parametrize("kind", ["grey", "mosaic"])
def test_torch_finds_the_render_a_sound_operator(kind: str) -> None:
    case = Case(kind)
    splats, rotations, centres = case.leaves()
    windows, channels = (None if a is None else torch.from_numpy(a) for a in (case.windows, case.channels))
    optics = operators._optics(case.camera)
    fixed = [0.1, 0.2, 0.3], optics, case.camera.width, case.camera.height, 0.01
    torch.library.opcheck(operators._render, (*splats.values(), rotations, centres, None, windows, channels, *fixed))


def test_it_compiles_without_a_break() -> None:
    case = Case("colour")
    splats, rotations, centres = case.leaves()

    def loss(*given: Tensor) -> Tensor:
        return case.render(dict(zip(splats, given, strict=True)), rotations, centres).values.square().mean()

    eager = torch.autograd.grad(loss(*splats.values()), tuple(splats.values()))
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for a, b in zip(eager, torch.autograd.grad(compiled(*splats.values()), tuple(splats.values())), strict=True):
        torch.testing.assert_close(a, b)


def charge_case() -> tuple[Sensor, Tensor, Tensor, Tensor, Tensor]:
    """Sensor, image, frames, displacements and gain."""
    rng = np.random.default_rng(0)
    sensor = Sensor(32, 16, 20_000.0)
    frames = rng.integers(0, 256, (12, sensor.frame_bytes), np.uint8)
    nodes = -(-16 // WARP_CELL_PX) + 1, -(-32 // WARP_CELL_PX) + 1
    displacements = rng.normal(0, 0.5, (12, *nodes, 2)).astype(np.float32)
    image = rng.uniform(0.2, 0.8, (16, 32)).astype(np.float32)
    made = (torch.from_numpy(a) for a in (image, frames, displacements, np.ones((16, 32), np.float32)))
    return sensor, *made


def test_the_charge_loss_is_that_of_the_map() -> None:
    sensor, image, frames, displacements, gain = charge_case()
    image.requires_grad_()
    loss = operators.charge_loss(image, sensor, frames, displacements, gain, floor=0.05)
    (3 * loss).backward()
    arrays = image.detach().numpy(), frames.numpy(), displacements.numpy(), gain.numpy()
    expected = ChargeLoss(sensor)(*arrays, floor=0.05)
    assert loss.item() == pytest.approx(expected.loss) and expected.loss > 0
    assert image.grad is not None
    np.testing.assert_allclose(image.grad.numpy(), 3 * expected.slope, rtol=1e-6)
    layout = [32, 16, 1, 0, 0]
    given = image, frames, displacements, gain, None, layout, "", [1, 1, 0], 0.05, 0.02
    torch.library.opcheck(operators._charge_loss, given)


def test_dissimilarity_is_that_of_the_map() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 1, (2, 20, 30, 3)).astype(np.float32)
    rendered = torch.from_numpy(a).requires_grad_()
    operators.dssim(rendered, torch.from_numpy(b)).backward()
    expected = dssim(a, target=b)
    assert rendered.grad is not None
    np.testing.assert_array_equal(rendered.grad.numpy(), expected[1])
    torch.library.opcheck(operators._dssim_op, (rendered, torch.from_numpy(b), 1.0))


def test_a_scene_comes_back_from_tensors() -> None:
    scene = replace(render_scenes.splats(10, 3, 0), white=0.7)
    tensors = scene.to_torch()
    back = Scene.from_torch({name: t.double().requires_grad_() for name, t in tensors.items()}, scene.white)
    assert all(np.array_equal(a, b) for a, b in zip(scene.arrays(), back.arrays(), strict=True)) and back.white == 0.7
    tensors["means"].zero_()
    assert scene.means.any(), "the tensors are copies"


def test_mistakes_are_told() -> None:
    splats, rotations, centres = Case("colour").leaves()
    with pytest.raises(ConfigurationError, match=r"lack quats"):
        operators.render(CAMERA, {n: t for n, t in splats.items() if n != "quats"}, rotations, centres)
    with pytest.raises(ConfigurationError, match="on cpu, meta: give all on the CPU"):
        operators.render(CAMERA, splats | {"means": splats["means"].to("meta")}, rotations, centres)
    with pytest.raises(ConfigurationError, match=r"on meta: .*give tensor\.cpu\(\)"):
        operators.dssim(torch.zeros(4, 4), torch.zeros(4, 4, device="meta"))
    with pytest.raises(ConfigurationError, match="2 radiances"):
        operators.render(CAMERA, splats, rotations, centres, background=(0.1, 0.2))
    with pytest.raises(ConfigurationError, match="give one of them"):
        operators.render(CAMERA, splats, rotations, centres, weights=torch.ones(1), windows=torch.ones(1))
    with pytest.raises(ConfigurationError, match="sub-poses are"):
        operators.render(CAMERA, splats, rotations[0], centres)
    with pytest.raises(SceneError, match="quats not given"):
        Scene.from_torch({n: t for n, t in splats.items() if n != "quats"})
    with pytest.raises(SceneError, match="no scene"):
        Scene.from_torch(splats | {"colours": torch.ones(60, 2)})
    with pytest.raises(SceneError, match="not finite"):
        Scene.from_torch(splats | {"colours": torch.full((60, 3), torch.nan)})


def test_the_example_trains(tmp_path: Path) -> None:
    scene = render_scenes.splats(200, 1, 0)
    scene.write_ply(tmp_path / "scene.ply", white=1.0)
    command = [sys.executable, ROOT / "examples" / "own_loss.py", tmp_path / "scene.ply", tmp_path / "trained.ply"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    first, last = (float(line.split()[-1]) for line in (said[0], said[-1]))
    assert last < 0.3 * first, said
    assert len(Scene.read_ply(tmp_path / "trained.ply")) == 200
