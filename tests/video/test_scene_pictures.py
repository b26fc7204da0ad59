"""Pictures of scenes beside the recorded path."""

from dataclasses import replace

import numpy as np
import pytest

from spiked.pose import quaternion
from spiked.render import Rasteriser
from spiked.trajectory import Trajectory
from spiked.video import recorded_path, scene_pictures

from ..room_map import CAMERA, RoomMap, room_map


@pytest.fixture(scope="module")
def room() -> RoomMap:
    return room_map(2, (0.0, 0.5))


def test_a_splat_that_reaches_the_camera_does_not_cover_the_picture(room: RoomMap) -> None:
    """A stick that points at the camera, beside the middle: drawn by its shape at its middle, it is a flat wall."""
    row = len(room.path) // 2
    rotation, centre = room.path.rotations[row], room.path.centres[row]
    depth = float(np.median(((room.scene.means - centre) @ rotation)[:, 2]))
    stick = replace(
        room.scene.select(np.zeros(2, np.int64)),
        means=np.asarray(depth * np.array([[0.3, 0.3, 0.5], [-0.3, 0.3, 0.5]]) @ rotation.T + centre, np.float32),
        quats=np.tile(np.asarray(quaternion(rotation), np.float32), (2, 1)),
        log_scales=np.log(depth * np.array([[8, 0.02, 8], [0.02, 8, 8]])).astype(np.float32),
        opacity_logits=np.full(2, 4, np.float32),
    )
    view = recorded_path(Trajectory(np.zeros(1), rotation[None], centre[None]))
    white = float(np.percentile(Rasteriser(CAMERA).forward(room.scene, rotation[None], centre[None]).values, 99))
    wanted, covered, bounded = (
        next(scene_pictures(scene, view, CAMERA, 1, white, beside)).astype(float)
        for scene, beside in ((room.scene, True), (room.scene.join(stick), False), (room.scene.join(stick), True))
    )
    unchanged = [float((np.abs(one - wanted) < 8).mean()) for one in (covered, bounded)]
    assert unchanged[0] < 0.3 and unchanged[1] > 0.5, unchanged
