"""Views by frame of a version with only the poses of the tracked views, as a long path has while it is tracked."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spiked_service.api.problems import NoPoseError
from spiked_service.api.results import Result
from spiked_service.api.schemas.views import ViewRequest
from spiked_service.api.views import views_response
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.results.image_encoding import ImageFormat
from spiked_service.results.versions import Publisher
from spiked_service.results.view_renderer import Pose, ViewRenderer

from spiked.pose import exp_so3
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory

RATE_HZ = 20_000.0
SENSOR = Sensor(32, 24, RATE_HZ, intrinsics=Intrinsics.from_fov(32, 24, 60))


def published(folder: Path, every: int, posed_frames: int | None) -> Result:
    """A version with a pose of every so many of the frames 0 to 499 and 1,200 to 1,499; the camera moves evenly."""
    frames = np.r_[0:500:every, 1200:1500:every] + 0.5
    turns = exp_so3(np.stack([0 * frames, frames * 1e-4, 0 * frames], 1))
    path = Trajectory(frames / RATE_HZ, turns, np.stack([frames, 0 * frames, 0 * frames], 1))
    one = Publisher(folder).publish(Scene.empty(1), path, 1.0, posed_frames=posed_frames)
    return Result(folder, one, SENSOR, folder / "timeline")


class Watched(ViewRenderer):
    """Keeps the poses that are rendered."""

    poses: list[Pose]

    def render(self, scene: Path, camera: Any, pose: Pose) -> Any:
        self.poses.append(pose)
        return super().render(scene, camera, pose)


def pose_of(result: Result, frame: int) -> Pose:
    renderer = Watched(ConcurrencyLimit("renders", 1))
    renderer.poses = []
    request = ViewRequest.model_validate({"camera": {"frame": frame}, "width": 16, "height": 12})
    views_response(result, request, ImageFormat.PNG, renderer)
    return renderer.poses[0]


def test_a_frame_between_two_views_has_the_pose_between_theirs(tmp_path: Path) -> None:
    result = published(tmp_path, every=100, posed_frames=800)
    assert result.published.poses == 800 and len(result.poses()) == 8
    pose = pose_of(result, 130)
    assert pose.centre == pytest.approx([130.5, 0, 0])
    np.testing.assert_allclose(pose.rotation, exp_so3(np.array([0, 130.5e-4, 0])), atol=1e-9)


@pytest.mark.parametrize("frame", [430, 1199, 1450])
def test_a_frame_far_from_views_has_no_pose(tmp_path: Path, frame: int) -> None:
    """The camera was lost for 40 ms; and nothing is known behind the last view."""
    with pytest.raises(NoPoseError):
        pose_of(published(tmp_path, every=100, posed_frames=800), frame)


def test_lost_frames_of_a_whole_trajectory_have_no_pose(tmp_path: Path) -> None:
    result = published(tmp_path, every=1, posed_frames=None)
    assert pose_of(result, 130).centre == pytest.approx([130.5, 0, 0])
    with pytest.raises(NoPoseError):
        pose_of(result, 600)
