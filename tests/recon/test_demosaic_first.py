"""A mosaic's map fitted to interpolated colours, as a row of the comparison has it."""

from dataclasses import replace

import numpy as np
import pytest

from spiked.recon import MapOptions, Options, Reconstructor
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import SimulatedCamera
from spiked.trajectory import Trajectory

SENSOR = Sensor(128, 96, 20_000.0, mosaic=Mosaic.RGGB, intrinsics=Intrinsics.from_fov(128, 96, 60))
FRAMES = 160


@pytest.fixture(scope="module")
def recorded() -> tuple[np.ndarray, Trajectory]:
    camera = SimulatedCamera(SENSOR)
    rotations, centres = camera.truth(np.arange(FRAMES))
    return camera.next_frames(FRAMES), Trajectory((np.arange(FRAMES) + 0.5) / 20_000, rotations, centres)


def fitted(recorded: tuple[np.ndarray, Trajectory], mapping: MapOptions) -> Reconstructor:
    frames, path = recorded
    made = Reconstructor(SENSOR, Options(steps=60, poses=path, window_frames=16, mapping=mapping))
    made.feed(0, frames)
    made.finish()
    return made


def test_colours_interpolated_first_give_another_map_of_the_same_place(
    recorded: tuple[np.ndarray, Trajectory],
) -> None:
    last = fitted(recorded, MapOptions())
    first = fitted(recorded, replace(MapOptions(), demosaic_first=True))
    path = recorded[1]
    pictures = [made.view(path.rotations[80], path.centres[80]) for made in (last, first)]
    assert pictures[0].shape == pictures[1].shape == (96, 128, 3)
    difference = float(np.abs(pictures[0] - pictures[1]).mean())
    assert 0 < difference < 0.05
    assert float(pictures[1].std(axis=2).mean()) > 0.5 * float(pictures[0].std(axis=2).mean())
