"""Drivers that see the virtual cameras of a test."""

from collections.abc import Callable, Iterator

import pytest
from driving import Driver
from virtual_camera.rig import VirtualCameras


@pytest.fixture
def drive() -> Iterator[Callable[..., Driver]]:
    """Starts the driver on a source at a rig's machine, and ends it after the test."""
    drivers: list[Driver] = []

    def start(rig: VirtualCameras, spec: str, **options: int | None) -> Driver:
        drivers.append(Driver(rig, spec, **options))
        return drivers[-1]

    yield start
    for each in drivers:
        each.close()
