"""Cleaning: floaters go, the room stays, and a box cuts."""

from dataclasses import replace

import numpy as np
import pytest

from spiked.cleaning import Box, FloaterRemoval, Outline, clean
from spiked.errors import ConfigurationError
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene

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
    assert cleaned.floaters >= 50 and (cleaned.shrunk, cleaned.outside) == (0, 0)
    rasteriser, row = Rasteriser(CAMERA), len(room.path) // 2
    pose = room.path.rotations[row][None], room.path.centres[row][None]
    wanted, got = (rasteriser.forward(scene, *pose).values for scene in (room.scene, cleaned.scene))
    assert -10 * np.log10(np.mean((wanted - got) ** 2) / wanted.max() ** 2) > 30


def test_no_splat_is_larger_than_a_quarter_of_the_scene(room: RoomMap) -> None:
    large = room.scene.log_scales.copy()
    large[len(large) // 3] = np.log(50.0)
    cleaned = clean(
        replace(room.scene, log_scales=large), room.path, CAMERA, removal=FloaterRemoval(views=4, shrink=True)
    )
    low, high = np.percentile(cleaned.scene.means, (1, 99), axis=0)
    assert cleaned.shrunk == 1
    assert 3 * np.exp(cleaned.scene.log_scales.max()) <= 0.26 * np.linalg.norm(high - low)


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
