"""The scale of a scene by AprilTags."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tag_card import SIDE_M, TAG, card_scene, tag_card

from spiked.errors import ConfigurationError, SceneError
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.tag_scale import TAG_FAMILIES, Sighting, scale_by_sightings, scale_by_tags, tags_in
from spiked.trajectory import Trajectory

Array = NDArray[np.float64]
OPTICS, SIZE = Intrinsics.from_fov(640, 400, 60.0), (640, 400)
SIDE = 0.25
"""Of the tag, in the unit of the scene."""
CELL_PX, SAMPLES = 60, 4
FAR = 1.6


def towards(centre: Array) -> Array:
    """Rotation of a camera that looks from a place at the tag, at the origin of the plane z = 0."""
    z = -centre / np.linalg.norm(centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def picture(rotation: Array, centre: Array) -> NDArray[np.float32]:
    """The tag 7 of 36h11 with its white border, blurred by the pixels alone, [H, W]."""
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(TAG_FAMILIES["36h11"]), 7, 8)
    paper = np.kron(np.pad(marker, 2, constant_values=255), np.ones((CELL_PX, CELL_PX))).astype(np.float32) / 255
    texel = SIDE / 8 / CELL_PX
    place = np.array([[texel, 0, -6 * CELL_PX * texel], [0, texel, -6 * CELL_PX * texel], [0, 0, 1.0]])
    turn = rotation.T
    fine = OPTICS.scaled(SAMPLES).matrix() @ np.stack([turn[:, 0], turn[:, 1], -turn @ centre], axis=1)
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's warp counts pixel centres from 0
    mapping = np.linalg.inv(half) @ fine @ place @ half
    size = (SIZE[0] * SAMPLES, SIZE[1] * SAMPLES)
    image = cv2.warpPerspective(0.05 + 0.9 * paper, mapping, size, flags=cv2.INTER_LINEAR, borderValue=(0.4,))
    return np.asarray(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA), np.float32)


def seen(views: int, reach: float) -> list[Sighting]:
    """The tag from some places, up to `reach` to the sides."""
    found = []
    for angle in np.linspace(0, 2 * np.pi, views, endpoint=False):
        centre = np.array([reach * np.cos(angle), reach * np.sin(angle) / 2, -FAR])
        rotation = towards(centre)
        found += tags_in(picture(rotation, centre), OPTICS, rotation, centre)
    return found


def test_a_tag_of_10_cm_gives_metres_within_half_a_percent() -> None:
    found = scale_by_sightings(seen(8, 0.8), 0.10)
    assert [tag.tag for tag in found.tags] == [7]
    truth = 0.10 / SIDE
    print(f"scale error {100 * (found.metres_per_unit / truth - 1):+.3f} %, sigma {100 * found.sigma:.3f} %")
    assert found.metres_per_unit == pytest.approx(truth, rel=5e-3)
    assert abs(found.metres_per_unit / truth - 1) < 5 * found.sigma + 1e-3
    assert found.tags[0].error_px < 0.3


def test_a_tag_in_a_scene_of_splats_has_its_size() -> None:
    found = scale_by_tags(*card_scene(tag_card()), SIDE_M)
    assert [tag.tag for tag in found.tags] == [TAG]
    assert found.metres_per_unit == pytest.approx(1.0, abs=2e-3)  # the room is in metres


def test_a_tag_seen_from_one_place_gives_none() -> None:
    with pytest.raises(SceneError, match="from different sides"):
        scale_by_sightings(seen(6, 1e-3), 0.10)


def test_what_cannot_be_is_said() -> None:
    path = Trajectory(np.zeros(1), np.eye(3)[None], np.zeros((1, 3)))
    camera = Camera(OPTICS, *SIZE)
    with pytest.raises(SceneError, match="no tag is in any picture"):
        scale_by_tags(Scene.empty(1), path, camera, 0.1)
    with pytest.raises(ConfigurationError, match="36h11"):
        scale_by_tags(Scene.empty(1), path, camera, 0.1, family="12h3")
    with pytest.raises(ConfigurationError, match="positive"):
        scale_by_tags(Scene.empty(1), path, camera, 0.0)
