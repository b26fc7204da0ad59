"""Cleaning: floaters go, the room stays, and a box cuts."""

from dataclasses import replace

import numpy as np
import pytest

from spiked.cleaning import Box, FloaterRemoval, Outline, clean
from spiked.errors import ConfigurationError
from spiked.pose import exp_so3, quaternion
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.splitting import LEAST_BUDGET, split_large
from spiked.trajectory import Trajectory

from .room_map import CAMERA, RoomMap, room_map


@pytest.fixture(scope="module")
def room() -> RoomMap:
    return room_map(2, (0.0, 0.5))


def floaters(room: RoomMap, count: int) -> Scene:
    """Small splats in the air that one view sees from near, and one that is as large as the room."""
    rng = np.random.default_rng(0)
    rotation, centre = room.path.rotations[0], room.path.centres[0]
    means = centre + (np.array([0, 0, -0.5]) + rng.uniform(-0.3, 0.3, (count, 3))) @ rotation.T  # behind the camera
    one = room.scene.select(np.zeros(count, np.int64))
    return replace(one, means=means.astype(np.float32))


def test_floaters_go_and_pictures_stay(room: RoomMap) -> None:
    dirty = room.scene.join(floaters(room, 50))
    cleaned = clean(dirty, room.path, CAMERA, removal=FloaterRemoval(views=12))
    assert cleaned.floaters >= 50 and (cleaned.split, cleaned.shrunk, cleaned.outside) == (0, 0, 0)
    rasteriser, row = Rasteriser(CAMERA), len(room.path) // 2
    pose = room.path.rotations[row][None], room.path.centres[row][None]
    wanted, got = (rasteriser.forward(scene, *pose).values for scene in (room.scene, cleaned.scene))
    assert -10 * np.log10(np.mean((wanted - got) ** 2) / wanted.max() ** 2) > 30


def test_splats_that_hang_in_the_air_go_though_each_view_sees_them(room: RoomMap) -> None:
    row, count = len(room.path) // 2, 12
    rotation, centre = room.path.rotations[row], room.path.centres[row]
    rays = np.array([(x, y, 1) for x in (-0.3, -0.1, 0.1, 0.3) for y in (-0.15, 0, 0.15)])
    depth = 0.5 * np.median(((room.scene.means - centre) @ rotation)[:, 2])
    hanging = replace(
        room.scene.select(np.zeros(count, np.int64)),
        means=np.asarray(depth * rays @ rotation.T + centre, np.float32),
        log_scales=np.full((count, 3), np.log(0.01 * depth), np.float32),
        opacity_logits=np.full(count, 3, np.float32),
    )
    cleaned = clean(room.scene.join(hanging), room.path, CAMERA, removal=FloaterRemoval(split=False))
    alone = clean(room.scene, room.path, CAMERA, removal=FloaterRemoval(split=False))
    assert abs(cleaned.floaters - alone.floaters - count) <= 1
    assert alone.floaters < 0.2 * len(room.scene)


def test_a_place_of_large_splats_that_few_views_see_stays(room: RoomMap) -> None:
    """As a walk through several rooms shows them: one for a long time, another from afar and for a moment."""
    away, some = np.float32(50), room.scene.select(np.arange(0, len(room.scene), 49))
    other = replace(some, means=some.means + away, log_scales=some.log_scales + np.float32(np.log(12)))
    rows = np.append(np.zeros(60, np.int64), [len(room.path) - 1] * 4)
    path = Trajectory(
        np.arange(64) / 20_000,
        room.path.rotations[rows],
        room.path.centres[rows] + np.where(np.arange(64) < 60, 0, away)[:, None],
    )
    removal = FloaterRemoval(split=False)
    cleaned = clean(room.scene.join(other), path, CAMERA, removal=removal)
    seen_alone = clean(other, path, CAMERA, removal=removal)
    there = int((cleaned.scene.means[:, 0] > away / 2).sum())
    assert there > 0.9 * len(seen_alone.scene) > 0.3 * len(other)


def with_large_splats(room: RoomMap) -> Scene:
    """The room with three huge splats that views see: two sheets and a stick, behind everything; and one behind the
    camera that none sees."""
    row = len(room.path) // 2
    rotation, centre = room.path.rotations[row], room.path.centres[row]
    distance = 1.2 * np.percentile(((room.scene.means - centre) @ rotation)[:, 2], 99)
    at = np.array([[0.1, 0.2, distance], [-0.1, 0, 1.1 * distance], [0, 0.3, 0.2 * distance], [0, 0, -distance]])
    sizes = np.array([[50, 20, 0.02], [30, 9, 0.05], [40, 0.02, 0.02], [60, 60, 60]])
    huge = room.scene.select(np.zeros(4, np.int64))
    huge = replace(
        huge,
        means=np.asarray(at @ rotation.T + centre, np.float32),
        quats=np.tile(np.asarray(quaternion(rotation @ exp_so3([0.1, 0.2, 0.7])), np.float32), (4, 1)),
        log_scales=np.log(sizes).astype(np.float32),
        opacity_logits=np.array([2.0, 4.0, 0.5, 4.0], np.float32),
    )
    return room.scene.join(huge)


def test_large_splats_become_several_that_show_the_same(room: RoomMap) -> None:
    scene = with_large_splats(room)
    shares: list[float] = []
    removal = FloaterRemoval(views=4, least_views=0, lonely=np.inf)
    cleaned = clean(scene, room.path, CAMERA, removal=removal, progress=shares.append)
    assert (cleaned.split, cleaned.shrunk) == (3, 1)
    assert shares == sorted(shares) and shares[-1] == 1
    low, high = np.percentile(cleaned.scene.means, (1, 99), axis=0)
    assert 3 * np.exp(cleaned.scene.log_scales.max()) <= 0.26 * np.linalg.norm(high - low)
    rasteriser = Rasteriser(CAMERA)
    for row in np.linspace(0, len(room.path) - 1, 5).astype(int):
        pose = room.path.rotations[row][None], room.path.centres[row][None]
        without, wanted, got = (rasteriser.forward(s, *pose).values for s in (room.scene, scene, cleaned.scene))
        error, effect = np.mean((got - wanted) ** 2), np.mean((without - wanted) ** 2)
        assert error < 0.1 * effect, (row, error / effect)


def test_large_splats_become_no_wall_that_no_view_sees(room: RoomMap) -> None:
    """A cleaned scene is about as large as before, and has few splats more that no view sees."""
    scene = with_large_splats(room)
    removal = FloaterRemoval(views=16)
    cleaned = clean(scene, room.path, CAMERA, removal=removal)
    span = removal.span(room.scene)
    outside = np.linalg.norm(cleaned.scene.means - np.median(room.scene.means, axis=0), axis=1) > 1.5 * span
    assert outside.sum() < 0.005 * len(scene)
    assert removal.span(cleaned.scene) < 1.5 * span
    again = clean(cleaned.scene, room.path, CAMERA, removal=removal)
    assert again.split == 0 and again.floaters < 0.005 * len(scene)


def test_a_large_splat_far_behind_the_scene_is_kept(room: RoomMap) -> None:
    row = len(room.path) // 2
    rotation, centre = room.path.rotations[row], room.path.centres[row]
    far = 5 * float(np.median(((room.scene.means - centre) @ rotation)[:, 2]))
    sky = replace(
        room.scene.select(np.zeros(2, np.int64)),
        means=np.asarray(np.array([[0, 0, far], [0.5 * far, 0, far]]) @ rotation.T + centre, np.float32),
        quats=np.tile(np.asarray(quaternion(rotation), np.float32), (2, 1)),
        log_scales=np.log(np.array([[far, far, 1], [0.3 * far, 0.3 * far, 1]])).astype(np.float32),
        opacity_logits=np.full(2, 3, np.float32),
    )
    scene = room.scene.select(np.arange(0, len(room.scene), 40)).join(sky)
    split = split_large(scene, 1.0, room.path, CAMERA, 6.0)
    assert (split.split, split.left) == (2, 0)
    rasteriser, pose = Rasteriser(CAMERA), (rotation[None], centre[None])
    wanted, got = (rasteriser.forward(one, *pose).alpha.copy() for one in (scene, split.scene))
    assert np.abs(wanted - got).mean() < 0.05 * wanted.mean()


def test_a_scene_of_nothing_but_large_splats_keeps_to_a_budget(room: RoomMap) -> None:
    scene = with_large_splats(room)
    few = scene.select(np.arange(len(scene) - 2000, len(scene)))
    many = few.join(few.select(np.full(400, len(few) - 3, np.int64)))
    split = split_large(many, 0.1, room.path, CAMERA, 3.0)
    assert split.left > 0 and split.split > 0
    assert len(split.scene) <= len(many) + LEAST_BUDGET
    assert (np.exp(split.scene.log_scales).max(axis=1) > 0.1001).sum() == split.left


def test_a_sky_that_would_be_millions_stays(room: RoomMap) -> None:
    few = room.scene.select(np.arange(0, len(room.scene), 40))
    row = len(room.path) // 2
    rotation, centre = room.path.rotations[row], room.path.centres[row]
    sky = replace(
        few.select(np.zeros(1, np.int64)),
        means=np.asarray(np.array([[0, 0, 1e6]]) @ rotation.T + centre, np.float32),
        log_scales=np.full((1, 3), np.log(1e6), np.float32),
    )
    split = split_large(few.join(sky), 1.0, room.path, CAMERA, 6.0)
    assert (split.split, split.shrunk, split.left) == (0, 0, 1)
    np.testing.assert_array_equal(split.scene.log_scales, few.join(sky).log_scales)


def test_a_box_cuts(room: RoomMap) -> None:
    low, high = np.percentile(room.scene.means, (10, 90), axis=0)
    box = Box(tuple(low.tolist()), tuple(high.tolist()))
    cleaned = clean(room.scene, room.path, CAMERA, box=box)
    assert cleaned.outside + len(cleaned.scene) == len(room.scene) and 0 < cleaned.outside < len(room.scene)
    assert box.contains(cleaned.scene).all()


def test_an_outline_cuts_what_is_behind_it(room: RoomMap) -> None:
    row = len(room.path) // 2
    rotation, centre = room.path.rotations[row], room.path.centres[row]
    # An L: its notch, at the lower right, stays. The camera says which splats are where.
    w, h = CAMERA.width / 8, CAMERA.height / 8
    pixels = np.array([[2 * w, 2 * h], [6 * w, 2 * h], [6 * w, 4 * h], [4 * w, 4 * h], [4 * w, 6 * h], [2 * w, 6 * h]])
    outline = Outline(CAMERA.intrinsics.unproject(pixels)[:, :2], rotation, centre)
    seen = (room.scene.means - centre) @ rotation
    x, y = CAMERA.intrinsics.project(seen).T
    wanted = (x > 2 * w) & (x < 6 * w) & (y > 2 * h) & (y < 6 * h) & ~((x > 4 * w) & (y > 4 * h)) & (seen[:, 2] > 0)
    assert 20 < wanted.sum() < len(room.scene) / 2
    np.testing.assert_array_equal(outline.contains(room.scene), wanted)
    cleaned = clean(room.scene, room.path, CAMERA, outline=outline)
    assert cleaned.outlined == wanted.sum() and len(cleaned.scene) == (~wanted).sum()
    behind = Outline(outline.corners, rotation @ np.diag([-1.0, 1.0, -1.0]), centre)
    assert not behind.contains(room.scene.select(seen[:, 2] > 0)).any(), "nothing behind the camera"


@pytest.mark.parametrize("corners", [[[0, 0], [1, 1]], [[0, 0], [1, 1], [np.nan, 0]], [[0, 0, 0]] * 3])
def test_what_is_no_outline_is_refused(corners: list[list[float]]) -> None:
    with pytest.raises(ConfigurationError, match="an outline has"):
        Outline(np.array(corners, float), np.eye(3), np.zeros(3))


def test_what_leaves_nothing_is_refused(room: RoomMap) -> None:
    with pytest.raises(ConfigurationError, match="nothing of the scene"):
        clean(room.scene, room.path, CAMERA, box=Box((90, 90, 90), (91, 91, 91)))
    with pytest.raises(ConfigurationError, match="is empty"):
        Box((1, 0, 0), (0, 1, 1))
