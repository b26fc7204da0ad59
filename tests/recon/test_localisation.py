"""A camera is found in a map of the place where it is, and nowhere else."""

import numpy as np
import pytest
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, RecordingError, SceneError
from spiked.pose import log_so3
from spiked.recon import Localisation, Localiser, MapIndex
from spiked.recon.frontend.features import Features, match
from spiked.recon.localisation.recognition import LEAST_CORRELATION, LEAST_INLIERS, LEAST_SHARE
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Sensor
from spiked.simulate import SimulatedCamera

from ..room_map import OPTICS, SENSOR, room_map, twice, visitor

FRAMES = 400
NEAR_M = 0.03
"""Position error: the map's splats are as large as its pixels, 8 mm at the depth of the table."""


@pytest.fixture(scope="module")
def index() -> MapIndex:
    made = room_map(2)
    return MapIndex(made.scene, made.path, Camera(OPTICS, SENSOR.width, SENSOR.height))


@pytest.fixture(scope="module")
def camera() -> SimulatedCamera:
    return visitor(2)


@pytest.fixture(scope="module")
def frames(camera: SimulatedCamera) -> NDArray[np.uint8]:
    return camera.next_frames(FRAMES)


def localised(index: MapIndex, frames: NDArray[np.uint8], first: int = 0) -> Localisation:
    localiser = Localiser(index, SENSOR)
    for begin in range(0, len(frames), 100):
        localiser.feed(first + begin, frames[begin : begin + 100])
    return localiser.finish()


def test_a_camera_beside_the_path_is_found(index: MapIndex, camera: SimulatedCamera, frames: NDArray[np.uint8]) -> None:
    found = localised(index, frames)
    assert found.recognised, found.reason
    assert found.agreeing == found.searches >= 2
    path = found.trajectory(SENSOR.frame_rate_hz)
    rotations, centres = camera.truth(path.times_s * SENSOR.frame_rate_hz - 0.5)
    assert path.times_s[-1] - path.times_s[0] > 0.8 * FRAMES / SENSOR.frame_rate_hz
    assert np.linalg.norm(path.centres - centres, axis=1).max() < NEAR_M
    assert np.degrees(np.linalg.norm(log_so3(path.rotations.swapaxes(1, 2) @ rotations), axis=1)).max() < 0.5
    for view in found.views:
        assert view.fit.inliers >= LEAST_INLIERS and view.fit.share >= LEAST_SHARE
        assert view.correlation >= LEAST_CORRELATION
        assert 0 < view.fit.sigma < NEAR_M and 0 < view.fit.sigma_px < 1


def test_the_same_furniture_with_other_textures_is_not_recognised(index: MapIndex) -> None:
    found = localised(index, visitor(3).next_frames(FRAMES))
    assert not found.recognised and found.views == []
    assert found.reason.startswith("not recognised: ")
    assert f"{len(index)} reference views" in found.reason


def test_two_places_that_look_alike_are_not_told_apart(frames: NDArray[np.uint8]) -> None:
    made = twice(room_map(2))
    found = localised(MapIndex(made.scene, made.path, Camera(OPTICS, SENSOR.width, SENSOR.height)), frames)
    assert not found.recognised
    assert "several places of the map look like the recording" in found.reason


def test_a_camera_is_found_again_after_a_gap(
    index: MapIndex, camera: SimulatedCamera, frames: NDArray[np.uint8]
) -> None:
    localiser = Localiser(index, SENSOR)
    localiser.feed(0, frames[:150])
    localiser.feed(250, frames[250:])
    found = localiser.finish()
    assert found.recognised
    times = np.array([view.time for view in found.views])
    assert (times < 150).any() and (times > 250).any()
    _, centres = camera.truth(times - 0.5)
    assert np.linalg.norm([view.pose.centre for view in found.views] - centres, axis=1).max() < NEAR_M


def test_a_search_that_finds_nothing_is_repeated_soon(index: MapIndex, frames: NDArray[np.uint8]) -> None:
    """The next search used to come after 10 ms, which was too late for 12 ms of a fast camera."""
    late = frames[:240].copy()
    late[:60] = 0
    assert localised(index, late).recognised


def test_dim_views_are_longer(index: MapIndex) -> None:
    """At 0.035 spikes a frame of white, windows of 16 frames agree with the map in 23 % of its points."""
    found = localised(index, visitor(2, gain=0.035, flow_px=0.015).next_frames(600))
    assert found.recognised, found.reason


def test_short_and_dark_recordings_are_refused(index: MapIndex, frames: NDArray[np.uint8]) -> None:
    with pytest.raises(RecordingError, match="too short"):
        localised(index, frames[:20])
    with pytest.raises(RecordingError, match="too little texture or light"):
        localised(index, np.zeros_like(frames))


def test_an_index_needs_a_map_and_a_recording_of_its_camera(index: MapIndex) -> None:
    made = room_map(2)
    with pytest.raises(SceneError, match="empty"):
        MapIndex(Scene.empty(1), made.path, index.camera)
    with pytest.raises(ConfigurationError, match="make the index for the camera of the recording"):
        Localiser(index, Sensor(320, 160, 20_000.0))


def test_references_are_spread_by_image_motion(index: MapIndex) -> None:
    for number, reference in enumerate(index.references):
        others = np.delete(index.shifts_px(reference.pose), number)
        assert others.min() > 20  # 40 px at a width of 400


def test_matches_are_mutual_and_clear() -> None:
    rng = np.random.default_rng(0)
    made = rng.normal(size=(20, 128)).astype(np.float32)
    made /= np.linalg.norm(made, axis=1, keepdims=True)
    a = Features(np.zeros((20, 2)), made)
    twin = made.copy()
    twin[1] = twin[0]  # two alike: neither is matched
    rows, columns = match(a, Features(np.zeros((20, 2)), twin))
    assert rows.tolist() == columns.tolist() == list(range(2, 20))
