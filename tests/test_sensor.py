"""Geometry, layout and colour pattern of a camera."""

import numpy as np
import pytest

from spiked.errors import ConfigurationError
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Sensor


@pytest.mark.parametrize(
    ("sensor", "frame_bytes"),
    [
        (Sensor(400, 250, 20_000.0), 12_500),
        (Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED), 13_000),
        (Sensor(1000, 1000, 40_000.0), 125_000),
        (Sensor(640, 360, 40_000.0), 28_800),
    ],
)
def test_frame_sizes_are_those_of_the_known_flavours(sensor: Sensor, frame_bytes: int) -> None:
    assert sensor.frame_bytes == frame_bytes


def test_the_compact_camera_has_neither_row_numbers_nor_another_bit_order() -> None:
    sensor = Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED, BitOrder.MSB, mosaic=Mosaic.BGGR)
    assert sensor.compact() == Sensor(400, 250, 20_000.0, mosaic=Mosaic.BGGR)


@pytest.mark.parametrize(("width", "height", "rate"), [(401, 250, 1.0), (0, 250, 1.0), (8, -1, 1.0), (8, 1, 0.0)])
def test_impossible_cameras_are_refused(width: int, height: int, rate: float) -> None:
    with pytest.raises(ConfigurationError):
        Sensor(width, height, rate)


def test_the_mosaic_names_the_upright_image_row_by_row() -> None:
    assert Mosaic.BGGR.channels(3, 3).tolist() == [[2, 1, 2], [1, 0, 1], [2, 1, 2]]


def test_a_right_angle_of_view_has_half_the_width_as_focal_length() -> None:
    camera = Intrinsics.from_fov(400, 250, 90)
    assert (camera.fx, camera.cx, camera.cy) == (pytest.approx(200), 200, 125)


def test_pixels_and_points_project_onto_each_other() -> None:
    k = Intrinsics(420.0, 400.0, 201.0, 120.0)
    pixels = np.random.default_rng(0).uniform(0, 400, (5, 7, 2))
    rays = k.unproject(pixels)
    assert (rays[..., 2] == 1).all()
    np.testing.assert_allclose(rays @ k.matrix().T, np.concatenate([pixels, np.ones((5, 7, 1))], -1))
    np.testing.assert_allclose(k.project(3 * rays), pixels)
    assert np.isfinite(k.project(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, -1.0]]))).all()


def test_scaled_intrinsics_see_the_same_rays() -> None:
    k = Intrinsics(420.0, 400.0, 201.0, 120.0)
    pixel = np.array([10.0, 30.0])
    np.testing.assert_allclose(k.scaled(0.5).unproject(0.5 * pixel), k.unproject(pixel))
