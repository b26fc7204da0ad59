"""Two maps of one place become one; maps of two places do not."""

from dataclasses import replace

import numpy as np
import pytest

from spiked.errors import SceneError
from spiked.evaluate import Similarity
from spiked.pose import exp_so3, log_so3, rotation_of
from spiked.recon import KnownMap, NotOnePlaceError, merge
from spiked.recon.mapping.replay import Replay
from spiked.recon.merging.joining import Joint, join
from spiked.recon.merging.known_map import coloured, inverse, moved_scene
from spiked.recon.merging.path_warp import PathWarp
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory

from ..room_map import CAMERA, RoomMap, room_map, twice

LEFT, RIGHT = (0.0, 0.5), (0.45, 0.95)
"""Where the cameras of two maps look, in radians; a view is as wide as 1.05."""
ELSEWHERE = Similarity(0.7, exp_so3(np.array([0.3, -0.8, 1.9])), np.array([4.0, -1.0, 2.5]))
"""From the first map's frame of reference to the second's."""
DIMMER = 0.8
TINT = 1.4, 1.0, 0.6
"""Factors of red, green and blue with a mean of 1 over the sites of a mosaic."""
NEAR_M = 0.02
"""The splats are as large as the pixels, 8 mm at the depth of the table."""


def known(made: RoomMap) -> KnownMap:
    return KnownMap(replace(made.scene, white=0.35), made.path, CAMERA)


@pytest.fixture(scope="module")
def left() -> KnownMap:
    return known(room_map(2, LEFT))


@pytest.fixture(scope="module")
def right() -> KnownMap:
    """The right of the same room, in another frame of reference, unit and light."""
    return known(room_map(2, RIGHT)).moved(ELSEWHERE, DIMMER)


@pytest.fixture(scope="module")
def joint(left: KnownMap, right: KnownMap) -> Joint:
    return join(left, right)


def test_the_similarity_of_two_maps_is_found(joint: Joint) -> None:
    found = joint.registration
    assert found.similarity.scale == pytest.approx(1 / ELSEWHERE.scale, rel=2e-3)
    assert found.scale_sigma < 2e-3
    turned = found.similarity.rotation @ ELSEWHERE.rotation
    assert np.degrees(np.linalg.norm(log_so3(turned))) < 0.1
    assert len(found.sightings) >= 5 and found.searched <= 24
    assert joint.brightness == pytest.approx(1 / DIMMER, rel=0.02)
    assert joint.alike >= 5 and joint.different == 0
    scales = [one.scale for one in found.warp.similarities]
    assert scales == pytest.approx([1 / ELSEWHERE.scale] * len(scales), rel=0.01)


def test_the_second_map_lies_in_the_first_ones_frame(joint: Joint) -> None:
    truth = room_map(2, RIGHT).path
    assert np.linalg.norm(joint.second.trajectory.centres - truth.centres, axis=1).max() < NEAR_M
    assert (
        np.degrees(
            np.linalg.norm(log_so3(joint.second.trajectory.rotations.swapaxes(1, 2) @ truth.rotations), axis=1)
        ).max()
        < 0.2
    )


def test_a_surface_that_both_show_keeps_the_splats_of_one(joint: Joint) -> None:
    first, second = joint.kept()
    assert first.mean() > 0.95, "the second shows nothing more finely"
    assert 0.15 < second.mean() < 0.5, "a part of it shows what the first never saw"


@pytest.mark.slow
def test_the_merged_map_shows_what_both_showed(left: KnownMap, right: KnownMap) -> None:
    shares: list[float] = []
    merged = merge(left, right, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert merged.kept[0] + merged.kept[1] <= len(merged.scene)
    # Of views of the path beside those that were rehearsed, in the second map's frame of reference.
    path, rasteriser = right.trajectory, rasteriser_for(CAMERA)
    before = [Replay.of(rasteriser, right.scene, path.rotations[row], path.centres[row]) for row in (3, 31, 57)]
    similarity = merged.joint.registration.similarity
    again = KnownMap(merged.scene, path, CAMERA).moved(inverse(similarity), 1 / merged.joint.brightness)
    psnr_db = -10 * np.log10([one.error(again.scene, 0.35 * DIMMER) for one in before])
    assert psnr_db.min() > 30
    assert min(merged.psnr_db) > 32


def test_the_same_furniture_with_other_textures_is_refused(left: KnownMap) -> None:
    with pytest.raises(NotOnePlaceError, match="these two do not show the same place"):
        join(left, known(room_map(3, RIGHT)))


def test_two_places_that_look_alike_are_not_told_apart(right: KnownMap) -> None:
    both = known(twice(room_map(2, LEFT)))
    with pytest.raises(NotOnePlaceError):
        join(both, right)
    with pytest.raises(NotOnePlaceError, match=r"one placement and \d+ on another"):
        join(right, both)


def tinted(made: KnownMap) -> KnownMap:
    """The map in colours that a grey camera does not tell from those of the map."""
    scene = coloured(made.scene)
    return replace(made, scene=replace(scene, colours=scene.colours * np.array(TINT, np.float32)))


def test_a_grey_map_says_nothing_of_colours(left: KnownMap) -> None:
    assert coloured(left.scene).colours.shape == (len(left.scene), 3)
    path, rasteriser = left.trajectory, rasteriser_for(CAMERA)
    seen = Replay.of(rasteriser, left.scene, path.rotations[9], path.centres[9])
    assert seen.error(tinted(left).scene, 0.35) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("grey_first", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_map_in_colour_keeps_its_colours_beside_a_grey_one(left: KnownMap, grey_first: bool) -> None:
    maps = (left, tinted(left)) if grey_first else (tinted(left), left)
    made = merge(*maps)
    assert min(made.psnr_db) > 32
    path = left.trajectory
    image = Replay.of(rasteriser_for(CAMERA), made.scene, path.rotations[20], path.centres[20]).values
    red, green, blue = np.median(image, (0, 1))
    assert (red / green, blue / green) == pytest.approx((TINT[0] / TINT[1], TINT[2] / TINT[1]), rel=0.05)


def test_colours_by_direction_stay_with_a_map_that_is_joined(left: KnownMap) -> None:
    harmonics = np.zeros((len(left.scene), 3, 1), np.float32)
    harmonics[:, 2] = 0.1
    seen = replace(left, scene=replace(left.scene, harmonics=harmonics))
    assert (coloured(seen.scene).seen_from(np.zeros(3)).colours == seen.scene.seen_from(np.zeros(3)).colours).all()

    turn = Similarity(1.0, exp_so3(np.array([0.3, 0.2, 0.1])), np.zeros(3))
    warp = PathWarp(np.array([1.0, 3.0]), [Similarity(1.0, np.eye(3), np.zeros(3)), turn])
    weights = np.zeros((len(left.scene), 2), np.float32)
    weights[::2, 0], weights[1::2, 1] = 1, 1
    moved = warp.scene(seen.scene, weights, np.array([1.0, 3.0]), 2.0)
    for rows, similarity in ((slice(0, None, 2), warp.similarities[0]), (slice(1, None, 2), turn)):
        alone = moved_scene(seen.scene, similarity, 2.0)
        centre = np.array([0.1, 0.2, -0.3])
        np.testing.assert_allclose(moved.seen_from(centre).colours[rows], alone.seen_from(centre).colours[rows], 1e-5)


def test_an_empty_map_is_refused(left: KnownMap) -> None:
    empty = replace(left, scene=Scene.empty(1))
    for pair in ((left, empty), (empty, left)):
        with pytest.raises(SceneError, match="empty"):
            join(*pair)


def test_paths_of_several_recordings_are_put_one_after_the_other(left: KnownMap, right: KnownMap) -> None:
    late = Trajectory(right.trajectory.times_s + 5, right.trajectory.rotations, right.trajectory.centres)
    made = KnownMap.of(left.scene, [left.trajectory, late], CAMERA)
    assert len(made.trajectory) == len(left.trajectory) + len(late)
    assert (np.diff(made.trajectory.times_s) > 0).all() and made.trajectory.times_s[0] == 0


def test_each_part_of_a_way_moves_by_its_own_similarity() -> None:
    half = Similarity(0.5, exp_so3(np.array([0.0, 0.0, 0.2])), np.array([1.0, 0.0, 0.0]))
    warp = PathWarp(np.array([1.0, 3.0]), [Similarity(1.0, np.eye(3), np.zeros(3)), half])
    rotations, centres = np.stack([np.eye(3)] * 4), np.array([[2.0, 0.0, 0.0]] * 4)
    turned, moved = warp.poses(np.array([0.0, 1.0, 2.0, 9.0]), rotations, centres)
    end = half.points(centres[0])
    assert moved == pytest.approx(np.array([centres[0], centres[0], (centres[0] + end) / 2, end]))
    assert log_so3(turned)[:, 2] == pytest.approx([0, 0, 0.1, 0.2])
    assert warp.at(2.0).scale == pytest.approx(np.sqrt(0.5))
    one = Scene(*(np.zeros(shape, np.float32) for shape in ((1, 3), (1, 4), (1, 3), 1, (1, 1))))
    there = warp.scene(one, np.array([[0.0, 1.0]], np.float32), np.array([1.0, 3.0]), 2.0)
    assert there.means[0] == pytest.approx([1, 0, 0]) and there.log_scales[0, 0] == pytest.approx(np.log(0.5))
    assert log_so3(rotation_of(there.quats[0]))[2] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("width", "height", "fov_deg"),
    [
        pytest.param(360, 360, 80, id="wider, and square"),
        pytest.param(400, 250, 40, id="narrower, at 2.6 times the resolution"),
        pytest.param(120, 80, 60, id="half the resolution"),
    ],
)
@pytest.mark.parametrize("first", ["the usual", pytest.param("the other", marks=pytest.mark.slow)])
def test_maps_of_different_cameras_are_merged(
    left: KnownMap, width: int, height: int, fov_deg: float, first: str
) -> None:
    camera = Camera(Intrinsics.from_fov(width, height, fov_deg), width, height)
    other = room_map(2, RIGHT, camera)
    maps = [left, KnownMap(replace(other.scene, white=0.35), other.path, camera)]
    if first == "the other":
        maps.reverse()
    made = merge(*maps)
    assert made.joint.first.camera == maps[0].camera
    moved, truth = made.joint.second.trajectory, maps[1].trajectory
    assert np.linalg.norm(moved.centres - truth.centres, axis=1).max() < 0.04
    assert made.joint.registration.similarity.scale == pytest.approx(1, rel=0.005)
    assert made.joint.alike == len(made.joint.second_views) and min(made.psnr_db) > 24
