"""Schedule, densification, seeding, losses and render requests of the map, each by itself."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from spiked.recon.frontend.windowing import luminance
from spiked.recon.mapping.densification import DensifyStrategy
from spiked.recon.mapping.loss import RateLoss
from spiked.recon.mapping.mapper import BETAS, Mapper
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.pyramid import Target
from spiked.recon.mapping.rates import FAST_RATES, RATES
from spiked.recon.mapping.render_requests import RenderPlanner
from spiked.recon.mapping.schedule import Schedule
from spiked.recon.mapping.seeding import Seeding, isotropic_splats
from spiked.render import Camera
from spiked.render.descent import DeviceDescent, descent_for
from spiked.render.loss import dssim
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Mosaic, Sensor

CAMERA = Camera(Intrinsics(200.0, 200.0, 80.0, 50.0), 160, 100)


def test_a_schedule_ends_at_full_size_with_rates_of_zero() -> None:
    schedule = Schedule()
    shares = np.linspace(0, 1, 101)
    rates = [schedule.rate(share) for share in shares]
    assert rates[0] == 1 and rates[-1] == 0 and rates == sorted(rates, reverse=True)
    coarse = [schedule.coarseness(share) for share in shares]
    assert coarse[0] == 1 and coarse == sorted(coarse, reverse=True) and coarse[60] == pytest.approx(0) == coarse[-1]
    steps = [schedule.alignment_step(number) for number in (1, 2, 3)]
    assert steps == [1, 2 / 3, 1 / 2]


def test_large_images_get_fewer_steps_and_fast_motion_more() -> None:
    schedule = Schedule()
    assert schedule.steps(1600, schedule.small_pixels, 0.0) == 1600
    assert schedule.steps(1600, 4 * schedule.small_pixels, 0.0) == round(1600 / 4**0.4)
    assert schedule.steps(1600, schedule.small_pixels, 1.0) == 4800
    assert schedule.steps(1600, schedule.small_pixels // 2, 0.5) == 3200


def scene(opacity_logits: list[float]) -> Scene:
    count = len(opacity_logits)
    shapes, colours = ((count, 3), (count, 4), (count, 3)), np.ones((count, 1), np.float32)
    return Scene(*(np.zeros(shape, np.float32) for shape in shapes), np.float32(opacity_logits), colours)


def test_densification_is_due_every_so_many_steps_until_its_share() -> None:
    strategy = DensifyStrategy(every=5, until=0.5)
    assert [step for step in range(1, 12) if strategy.due(step, 0.2)] == [5, 10]
    assert not strategy.due(5, 0.5)


def test_fast_motion_adds_fewer_splats_at_a_time() -> None:
    strategy, error = DensifyStrategy(share=0.3, fast_share=0.1), np.ones((20, 20), np.float32)
    error[:10] = 2.0
    rng = np.random.default_rng(0)
    slow, fast = (strategy.choose(error, 0, 100, 100, rng, fast=fast) for fast in (False, True))
    assert slow is not None and fast is not None
    assert (len(slow[0]), len(fast[0])) == (30, 10)


def test_means_move_in_units_of_splats_or_of_the_scenes_depth() -> None:
    """A pixel at a depth of 3 with a focal length of 200 pixels is 0.015 wide."""
    own, world = RATES.axes(3.0, 200.0), FAST_RATES.axes(3.0, 200.0)
    assert own.own and own.blur == pytest.approx(0.015 * (RATES.blur_px or 0))
    assert not world.own and world.blur == 3.0


def test_a_map_has_one_kind_of_rates_and_no_moments_of_the_other() -> None:
    sensor = Sensor(64, 40, 20_000.0, intrinsics=Intrinsics(60, 60, 32, 20))
    camera = Camera(sensor.intrinsics, 64, 40)
    mapper = Mapper(sensor, camera, MapOptions(), seed=0, threads=1)
    image = np.random.default_rng(0).uniform(0.1, 0.9, (40, 64)).astype(np.float32)
    view = SimpleNamespace(rate=image, time=0.0)
    mapper.seed_view(view, np.eye(3), np.zeros(3), np.full((40, 64), 2.0, np.float32))  # type: ignore[arg-type]
    mapper.depth = 2.0
    moved = {}
    for fast in (True, False, True):
        mapper.fit_motion(fast)
        assert mapper.descent.adam.taken.max() == 0
        seen = mapper.rasteriser.forward(mapper.scene, np.eye(3)[None], np.zeros((1, 3)))
        before = mapper.scene.means.copy()
        mapper._descend(mapper.rasteriser, np.asarray(seen.values - 0.5, np.float32), 1.0, np.zeros(3))
        mapper.fit_motion(fast)
        assert mapper.descent.adam.taken.max() == 1
        moved[fast] = np.abs(mapper.scene.means - before)
    assert moved[True].max() == pytest.approx(2.0 * FAST_RATES.means, rel=1e-3)
    pixel = 2.0 / 60
    assert moved[False].max() > 1.2 * RATES.means * pixel and moved[False].max() > 2 * moved[True].max()


def test_faint_splats_are_dead() -> None:
    np.testing.assert_array_equal(DensifyStrategy().dead(np.array([0.5, -4.5, -3.5], np.float32)), [False, True, False])


def test_splats_are_added_where_the_error_is() -> None:
    error = np.zeros((50, 80), np.float32)
    error[20:30, 60:70] = -1
    rng = np.random.default_rng(0)
    chosen = DensifyStrategy(share=0.1).choose(error, replaced=3, cap=400, headroom=1000, rng=rng)
    assert chosen is not None
    rows, columns = chosen
    assert len(rows) == 43 and len(set(zip(rows, columns, strict=True))) == 43
    assert (np.abs(rows - 24.5) < 9).all() and (np.abs(columns - 64.5) < 9).all()


def test_nothing_is_added_without_room_or_error() -> None:
    strategy, rng, error = DensifyStrategy(), np.random.default_rng(0), np.eye(40, dtype=np.float32)
    assert strategy.choose(error, 5, 1000, 0, rng) is None
    assert strategy.choose(np.zeros_like(error), 5, 1000, 100, rng) is None
    some = strategy.choose(error, 5, 1000, 7, rng)
    assert some is not None and len(some[0]) == 7


def test_seeded_views_are_spread_and_begin_in_the_middle() -> None:
    order = Seeding(views=5).order([10, 11, 12, 13, 14, 15, 16, 17, 18])
    assert order[0] == 14 and sorted(order) == [10, 12, 14, 16, 18]


def test_a_live_map_is_seeded_again_as_the_path_grows() -> None:
    seeding, times = Seeding(), list(range(21))
    assert seeding.due(times, 13.9) and not seeding.due(times, 14.0)
    assert not seeding.due(times[:12], 0.0)


def test_planes_span_the_depths_of_the_points_in_front() -> None:
    seeding = Seeding()
    planes = seeding.planes(np.r_[np.linspace(1, 4, 200), -1.0])
    assert planes == (pytest.approx(1.3, rel=0.05), pytest.approx(0.5 / 4, rel=0.05))
    assert seeding.planes(np.r_[np.ones(9), -np.ones(50)]) is None


def test_a_view_seeds_its_empty_pixels_evenly() -> None:
    empty = np.zeros((40, 60), bool)
    empty[:, 30:] = True
    chosen = Seeding().pixels(empty, 4.0, 1000)
    assert chosen is not None
    rows, columns = chosen
    assert len(rows) == 10 * 8 and (columns >= 30).all()
    assert Seeding().pixels(empty[:, :32], 4.0, 1000) is None
    few = Seeding().pixels(empty, 4.0, 25)
    assert few is not None and len(few[0]) == 25


def test_isotropic_splats_project_to_their_pixels() -> None:
    pixels, depth = np.array([[10.5, 20.5], [90.0, 60.0]]), np.float32([2, 3])
    rotation, centre = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], np.array([1.0, -2.0, 0.5])
    rotation *= np.linalg.det(rotation)
    made = isotropic_splats(CAMERA.intrinsics, pixels, depth, np.ones((2, 1), np.float32), 1.5, rotation, centre)
    local = (made.means - centre) @ rotation
    np.testing.assert_allclose(CAMERA.intrinsics.project(local), pixels, atol=1e-3)
    np.testing.assert_allclose(local[:, 2], depth, rtol=1e-5)
    np.testing.assert_allclose(np.exp(made.log_scales), np.repeat(1.5 * depth[:, None] / 200, 3, 1), rtol=1e-5)


@pytest.mark.parametrize("mosaic", [None, Mosaic.RGGB])
@pytest.mark.parametrize("ssim", [0.0, 1.0])
def test_the_gradient_of_the_rate_loss_is_that_of_finite_differences(ssim: float, mosaic: Mosaic | None) -> None:
    """By the squared error and by the structural term, which is not in the reported value, each alone."""
    rng = np.random.default_rng(1)
    values, image = rng.uniform(0.1, 0.4, (2, 20, 24)).astype(np.float32)
    loss, white = RateLoss(ssim=ssim, ssim_scale=1.0), 0.4
    target = Target(values, np.full(values.shape, 0.02, np.float32), None)
    _, slope = loss(image, target, white, mosaic)
    direction = np.zeros_like(image)
    direction[2:-2, 2:-2] = rng.normal(size=(16, 20))  # at the border `luminance` mirrors the image

    def value(moved: np.ndarray) -> float:
        if ssim == 0:
            return loss(moved, target, white, mosaic)[0]
        grey, seen = luminance(moved, mosaic), luminance(values, mosaic)
        return dssim(grey, target=seen, white=white)[0]

    ahead, behind = (value(image + np.float32(step) * direction) for step in (1e-3, -1e-3))
    assert np.float64(slope * direction).sum() == pytest.approx((ahead - behind) / 2e-3, rel=0.02)


def test_a_noisy_pixel_counts_less() -> None:
    loss = RateLoss(floor=0.03)
    weight = loss.certainty(np.float32([0, 0.03, 0.3, np.inf]), 1.0)
    np.testing.assert_allclose(weight, [1, 0.5, 1 / 101, 0], rtol=1e-5)


def test_image_motion_is_that_of_the_median_depth() -> None:
    planner = RenderPlanner(CAMERA, depth=2.0)
    moved = planner.motion_px(np.eye(3), np.zeros(3), np.eye(3), np.array([0.1, 0, 0]))
    assert moved == pytest.approx(200 * 0.1 / 2)
    planner.depth = 4.0
    nearer = planner.motion_px(np.eye(3), np.zeros(3), np.eye(3), np.array([0.1, 0, 0]))
    assert nearer == pytest.approx(moved / 2)


def test_a_map_of_a_gpu_goes_on_with_the_renderer_that_is_here() -> None:
    sensor = Sensor(64, 40, 20_000.0, intrinsics=Intrinsics(60, 60, 32, 20))
    mapper = Mapper(sensor, Camera(sensor.intrinsics, 64, 40), MapOptions(), seed=0)
    mapper.descent = DeviceDescent(scene([0.5, 1.0]), *BETAS)
    back = pickle.loads(pickle.dumps(mapper))
    assert type(back.descent) is type(descent_for(back.scene, *BETAS))
    np.testing.assert_array_equal(back.scene.opacity_logits, mapper.scene.opacity_logits)


@pytest.mark.parametrize("mosaic", [None, Mosaic.BGGR], ids=["grey", "colour"])
def test_white_rises_with_the_brightest_view_and_the_unit_stays(mosaic: Mosaic | None) -> None:
    """A walk from a dim room into a bright one: viewers cut off what is brighter than white."""
    sensor = Sensor(160, 100, 20000.0, mosaic=mosaic, intrinsics=CAMERA.intrinsics)
    mapper = Mapper(sensor, CAMERA, MapOptions(), seed=0, threads=1)
    depth = np.full((100, 160), 2.0, np.float32)
    noise = np.random.default_rng(0).normal(0, 0.02, (100, 160)).astype(np.float32)
    for brightness, white in [(0.1, 0.15), (0.12, 0.15), (0.3, 0.32), (0.2, 0.32)]:
        view = SimpleNamespace(rate=brightness + noise, time=0.0)
        mapper.seed_view(view, np.eye(3), np.zeros(3), depth)  # type: ignore[arg-type]
        assert mapper.white == pytest.approx(0.15, rel=0.05) and mapper.shown_white == pytest.approx(white, rel=0.05)
