"""Splats keep their places in the views they were seeded from when the path is corrected."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from spiked.pose import Array, exp_so3
from spiked.recon.frontend.windowing import View
from spiked.recon.mapping.carrying import Places, carried
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.seeding import isotropic_splats
from spiked.render import Camera, Rasteriser
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor

INTRINSICS = Intrinsics.from_fov(64, 48, 60)
CAMERA = Camera(INTRINSICS, 64, 48)
TURN, SHIFT, SCALE = np.array([0.1, -0.3, 0.2]), np.array([0.4, 0.1, -0.2]), 1.25


def wall(depth: float, at: Array) -> Scene:
    """Splats of different colours and shapes, seen by a camera at a place."""
    rng = np.random.default_rng(1)
    pixels = np.stack(np.meshgrid(np.arange(4.0, 64, 8), np.arange(4.0, 48, 8)), -1).reshape(-1, 2)
    depths = depth * (1 + 0.2 * rng.random(len(pixels))).astype(np.float32)
    colours = rng.random((len(pixels), 1)).astype(np.float32)
    scene = isotropic_splats(INTRINSICS, pixels, depths, colours, 3.0, np.eye(3), at)
    scene.quats[:] = rng.normal(size=scene.quats.shape)
    scene.log_scales += rng.normal(0, 0.4, scene.log_scales.shape).astype(np.float32)
    return scene


def seen(scene: Scene, rotation: Array, centre: Array) -> Array:
    return Rasteriser(CAMERA).forward(scene, rotation[None], centre[None]).values.copy()


def test_a_view_sees_its_carried_splats_as_before() -> None:
    scene = wall(2.0, np.zeros(3))
    n = len(scene)
    before = Places(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.ones(n))
    after = Places(np.tile(exp_so3(TURN), (n, 1, 1)), np.tile(SHIFT, (n, 1)), np.full(n, SCALE))
    moved = carried(scene, np.arange(n), before, after)
    expected = seen(scene, np.eye(3), np.zeros(3))
    assert expected.max() > 0.1
    assert seen(moved, exp_so3(TURN), SHIFT) == pytest.approx(expected, abs=2e-3)
    assert np.linalg.norm(moved.means - SHIFT, axis=1) == pytest.approx(
        SCALE * np.linalg.norm(scene.means, axis=1), rel=1e-5
    )
    assert np.abs(seen(moved, np.eye(3), np.zeros(3)) - expected).max() > 0.1


def test_the_motion_of_a_view_is_that_of_its_image() -> None:
    still = Places(np.eye(3)[None], np.zeros((1, 3)), np.ones(1))
    turned = Places(exp_so3(np.array([[0, 0.01, 0]])), np.zeros((1, 3)), np.ones(1))
    shifted = Places(np.eye(3)[None], np.array([[0.02, 0, 0]]), np.ones(1))
    grown = Places(np.eye(3)[None], np.zeros((1, 3)), np.array([1.01]))
    assert still.moved_px(still, 100, 2.0) == pytest.approx([0.0])
    for moved in (turned, shifted, grown):
        assert still.moved_px(moved, 100, 2.0) == pytest.approx([1.0], rel=0.01)


def test_only_the_splats_of_moved_views_are_carried(mapper: Mapper) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    mapper.seed_view(view(10.0), np.eye(3), np.zeros(3), depth)
    first = len(mapper)
    mapper.seed_view(view(20.0), np.eye(3), np.array([5.0, 0, 0]), depth)
    mapper._remove(np.arange(len(mapper)) < first // 2)
    assert mapper.homes.times == [10.0, 20.0]
    old, kept = mapper.scene.means.copy(), first - first // 2
    mapper.homes.note(places([0, 0, 0], [5, 0, 0]))
    mapper.carry(np.array([False, True]), places([0, 9, 0], [5, 1, 0]))
    moved = mapper.scene.means - old
    assert moved[:kept] == pytest.approx(np.zeros((kept, 3)))
    assert moved[kept:] == pytest.approx(np.tile([0, 1.0, 0], (len(mapper) - kept, 1)), abs=1e-6)
    assert mapper.homes.places.centres.tolist() == [[0, 0, 0], [5, 1, 0]]
    mapper.leave(np.array([True, False]))
    assert len(mapper) == len(moved) - kept


def test_splats_without_a_view_stay(mapper: Mapper) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    mapper.seed_view(view(10.0), np.eye(3), np.zeros(3), depth)
    mapper.homes.note(places([0, 0, 0]))
    mapper.adopt(mapper.scene)
    assert mapper.homes.times == [] and len(mapper.homes.places) == 0
    mapper.seed_view(view(20.0), np.eye(3), np.array([5.0, 0, 0]), depth)
    old = mapper.scene.means.copy()
    mapper.homes.note(places([0, 0, 0]))
    mapper.carry(np.array([True]), places([1, 1, 1]))
    assert set(np.unique((mapper.scene.means - old).round(5))) == {0.0, 1.0}


def places(*centres: list[float]) -> Places:
    n = len(centres)
    return Places(np.tile(np.eye(3), (n, 1, 1)), np.array(centres, float), np.ones(n))


@pytest.fixture
def mapper() -> Mapper:
    return Mapper(Sensor(64, 48, 20_000.0, intrinsics=INTRINSICS), CAMERA, MapOptions(), seed=0)


def view(time: float) -> View:
    """What seeding reads of one."""
    rate = np.random.default_rng(0).uniform(0.1, 0.2, (48, 64)).astype(np.float32)
    return cast(View, SimpleNamespace(rate=rate, time=time))
