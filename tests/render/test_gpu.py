"""The kernels of a GPU against the rasteriser of the CPU: in their emulation, and on a GPU where there is one."""

import pickle
import threading
from dataclasses import fields

import numpy as np
import pytest
import render_scenes as scenes
from test_moving import BACKGROUND, Case, relative

from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError
from spiked.native import _gpu
from spiked.render import Camera, Rasteriser, gpu
from spiked.render.descent import Descent, DeviceDescent, descent_for
from spiked.render.splats import MeanAxes, SizeLimits
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Mosaic

DEVICES = [
    "emulated",
    pytest.param("cuda", marks=pytest.mark.skipif(bool(_gpu.why_no_cuda()), reason=_gpu.why_no_cuda())),
]
PARAMETERS = "means", "quats", "log_scales", "opacity_logits", "colours", "rotation", "centre", "contribution"

pytestmark = pytest.mark.parametrize("device", DEVICES)


def assert_same(
    actual: gpu.GpuRasteriser,
    expected: Rasteriser,
    *args: object,
    moving: bool,
    bound: float = 1e-4,
    shares: bool = True,
    **kwargs: object,
) -> None:
    """Image and gradients of both for the same arguments; shares: each splat's contribution, too."""
    images = [getattr(one, "forward_moving" if moving else "forward")(*args, **kwargs) for one in (actual, expected)]
    for field in fields(images[0]):
        assert np.abs(getattr(images[0], field.name) - getattr(images[1], field.name)).max() < 2e-4, field.name
    d_values = np.random.default_rng(3).normal(size=images[1].values.shape).astype(np.float32)
    made, wanted = actual.backward(d_values), expected.backward(d_values)
    names = PARAMETERS if shares else PARAMETERS[:-1]
    worst = {name: relative(getattr(made, name), getattr(wanted, name)) for name in names}
    assert max(worst.values()) < bound, worst
    np.testing.assert_allclose(made.radius_px, wanted.radius_px, rtol=1e-3)


@pytest.mark.parametrize("colours", ["one", "three", "mosaic"])
def test_a_camera_that_stands_still(device: str, colours: str) -> None:
    camera = scenes.camera(83, 61)
    splats = scenes.splats(300, 1 if colours == "one" else 3, 5)
    rotations, centres = scenes.poses(3, 5)
    weights = np.random.default_rng(1).uniform(0, 1, (3, 61, 83)).astype(np.float32)
    channels = Mosaic.GRBG.channels(61, 83) if colours == "mosaic" else None
    assert_same(
        gpu.GpuRasteriser(camera, device=device),
        Rasteriser(camera, 1),
        splats,
        rotations,
        centres,
        weights=weights,
        channels=channels,
        background=BACKGROUND,
        moving=False,
    )


@pytest.mark.parametrize("name", ["one", "three colours", "mosaic"])
@pytest.mark.parametrize("sub_frames", [1, 3])
def test_a_camera_that_moves(device: str, name: str, sub_frames: int) -> None:
    case = Case(name, sub_frames=sub_frames)
    assert_same(
        gpu.GpuRasteriser(case.camera, device=device),
        Rasteriser(case.camera, 1),
        case.splats,
        case.rotations,
        case.centres,
        case.windows,
        channels=case.channels,
        background=BACKGROUND,
        moving=True,
        shares=False,  # the CPU counts pixels that do not look, too, if one of their block of 16 does
    )


@pytest.mark.parametrize("lens", [
    Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.001, -0.002, 0.0)),
    Distortion(LensModel.FISHEYE, (0.02, -0.01, 0.001, 0.0)),
])  # fmt: skip
@pytest.mark.parametrize("moving", [False, True])
def test_a_lens(device: str, lens: Distortion, moving: bool) -> None:
    camera = Camera(Intrinsics(40, 42, 23.0, 17.0, lens), 45, 35)
    rotations, centres = scenes.poses(2, 2, angle=0.02, shift=0.02)
    more = [np.stack([np.zeros((35, 45)), np.ones((35, 45))]).astype(np.float32)] if moving else []
    assert_same(
        gpu.GpuRasteriser(camera, device=device),
        Rasteriser(camera, 1),
        scenes.splats(150, 3, 7),
        rotations,
        centres,
        *more,
        moving=moving,
    )


def test_many_splats_on_one_tile(device: str) -> None:
    """More than a batch, in front of each other, until no light comes through: where that is differs a little."""
    camera = scenes.camera()
    splats = scenes.splats(3000, 1, 11, size=0.15)
    assert_same(
        gpu.GpuRasteriser(camera, device=device), Rasteriser(camera, 1), splats, np.eye(3)[None], np.zeros((1, 3)),
        moving=False, bound=2e-3,
    )  # fmt: skip


def test_nothing_to_see(device: str) -> None:
    camera = scenes.camera()
    rasteriser = gpu.GpuRasteriser(camera, device=device)
    for splats in (scenes.splats(0, 3, 1), _behind(scenes.splats(20, 3, 1))):
        image = rasteriser.forward(splats, np.eye(3)[None], np.zeros((1, 3)), background=0.25)
        assert (image.values == 0.25).all()
        assert not image.alpha.any()
        gradients = rasteriser.backward(np.ones_like(image.values))
        assert not any(getattr(gradients, name).any() for name in PARAMETERS)


def _behind(splats: Scene) -> Scene:
    return Scene(splats.means * [1, 1, -1] - [0, 0, 9], *splats.arrays()[1:])


def test_the_same_twice_to_the_bit(device: str) -> None:
    """Nothing is added up in an order that changes; and one rasteriser is used again for more, and for fewer splats."""
    case = Case("three colours")
    rasteriser = gpu.GpuRasteriser(case.camera, device=device)

    def run() -> list[np.ndarray]:
        image = rasteriser.forward_moving(case.splats, case.rotations, case.centres, case.windows)
        gradients = rasteriser.backward(case.d_values)
        return [image.values, image.alpha, image.depth, *(getattr(gradients, name) for name in PARAMETERS)]

    first = run()
    for count in (2000, 5):
        rasteriser.forward(scenes.splats(count, 1, 3), np.eye(3)[None], np.zeros((1, 3)))
        for once, again in zip(first, run(), strict=True):
            assert np.array_equal(once, again)


def test_errors_are_those_of_the_cpu(device: str) -> None:
    rasteriser = gpu.GpuRasteriser(scenes.camera(), device=device)
    with pytest.raises(ConfigurationError, match="there was none"):
        rasteriser.backward(np.zeros((35, 45), np.float32))
    with pytest.raises(ConfigurationError, match="sub-poses"):
        rasteriser.forward(scenes.splats(3, 1, 1), np.eye(3), np.zeros(3))
    with pytest.raises(ConfigurationError, match="near plane"):
        gpu.GpuRasteriser(scenes.camera(), near=0, device=device)


def test_too_much_for_one_render_is_told(device: str) -> None:
    """More than 2^30 pairs of splats and tiles: here 70,000 splats as large as the picture of 4096x4096."""
    splats = scenes.splats(70_000, 1, 1, size=30.0)
    splats.means[:, 2] = 100
    rasteriser = gpu.GpuRasteriser(Camera(Intrinsics(4000, 4000, 2048, 2048), 4096, 4096), device=device)
    with pytest.raises(ConfigurationError, match=r"2\^30 tiles.*SPIKED_RENDER=cpu"):
        rasteriser.forward(splats, np.eye(3)[None], np.zeros((1, 3)))
    small = scenes.splats(50, 1, 1)  # and it goes on
    assert np.isfinite(rasteriser.forward(small, np.eye(3)[None], np.zeros((1, 3))).values).all()


def test_rasterisers_in_several_threads(device: str) -> None:
    case = Case("one")
    expected = Rasteriser(case.camera, 1).forward_moving(case.splats, case.rotations, case.centres, case.windows)
    worst = []

    def work() -> None:
        rasteriser = gpu.GpuRasteriser(case.camera, device=device)
        for _ in range(5):
            image = rasteriser.forward_moving(case.splats, case.rotations, case.centres, case.windows)
            worst.append(np.abs(image.values - expected.values).max())

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(worst) == 20
    assert max(worst) < 2e-4


def test_descent_on_the_device(device: str) -> None:
    """Steps, splats moved, added and removed, and a checkpoint: the scene is that of the CPU."""
    case = Case("three colours")
    rates = (2e-2, 2e-3, 3e-3, 4e-2, 5e-3)
    limits, rng = SizeLimits(float(np.log(0.1)), 0.04, (0.1, -0.2, -1.0)), np.random.default_rng(8)
    keep = rng.random(150) < 0.8
    fits: list[Descent] = [Descent(_copy(case.splats), 0.9, 0.99, 1), DeviceDescent(_copy(case.splats), 0.9, 0.99, 1)]
    rasterisers = Rasteriser(case.camera, 1), gpu.GpuRasteriser(case.camera, device=device)
    more = scenes.splats(30, 3, 99)
    for turn in range(8):
        slopes = rng.normal(size=case.d_values.shape).astype(np.float32)
        for i, rasteriser in enumerate(rasterisers):
            if turn == 2:  # the same splats elsewhere
                moved = _copy(fits[i].scene)
                moved.means += np.float32(0.01)
                fits[i].replace(moved)
            if turn == 3:
                fits[i].join(more)
            if turn == 5:
                fits[i].select(keep)
            if turn in (4, 6):
                fits[i] = pickle.loads(pickle.dumps(fits[i]))
            if turn == 6:  # goes on with the renderer of this machine
                fits[i] = fits[i].moved()
                assert type(fits[i]) is type(descent_for(case.splats, 0.9, 0.99))
            rasteriser.forward_moving(fits[i].model, case.rotations, case.centres, case.windows)
            fits[i].step(rasteriser, slopes, rates, limits, MeanAxes(0.01, own=turn != 4))
        assert len(fits[0].model) == len(fits[1].model)
    ours, theirs = (fit.scene for fit in fits)
    width = np.exp(ours.log_scales).max(1, keepdims=True) + 0.01
    for mine, other, begin, rate, unit in zip(
        ours.arrays(),
        theirs.arrays(),
        case.splats.join(more).select(keep).arrays(),
        rates,
        (width, 1, 1, 1, 1),
        strict=True,
    ):
        assert (np.abs(mine - begin) / unit).max() > rate  # they moved
        assert (np.abs(mine - other) / unit).max() < 0.05 * rate
    most = limits.most(theirs.means)
    assert (theirs.log_scales <= most + 1e-5).all()
    assert (theirs.log_scales > most - 1e-5).any()
    assert 0.1 < (most < limits.log_scale).mean() < 0.9
    assert np.array_equal(fits[0].adam.taken, fits[1].adam.taken)


def _copy(scene: Scene) -> Scene:
    return scene.select(np.arange(len(scene)))
