"""A daemon with one short capture, shared by the tests of a module: reconstructing takes a while."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from spiked.client import CaptureOut, ReconstructionOptions, Spiked
from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera

FRAMES = 512
SIZE = (160, 100)


class Service:
    """A running daemon, by its client and by plain HTTP."""

    def __init__(self, daemon: Any) -> None:
        self.daemon = daemon
        self.client = Spiked(daemon.address)
        self.http: httpx.Client = daemon.http

    def capture(self, **more: Any) -> CaptureOut:
        """A short capture of the simulated camera, until it is over."""
        options = ReconstructionOptions(steps=20)
        started = self.client.start_capture(
            f"sim:?width={SIZE[0]}&height={SIZE[1]}", frames=FRAMES, options=options, **more
        )
        return self.client.wait_for_capture(started.id, 120)


@contextmanager
def running(folder: Path, daemon_class: Any) -> Iterator[Service]:
    """A daemon on that folder."""
    daemon = daemon_class(folder=folder)
    one = Service(daemon)
    try:
        yield one
    finally:
        one.client.close()
        daemon.close()


@pytest.fixture(scope="package")
def service(tmp_path_factory: pytest.TempPathFactory, daemon_class: Any) -> Iterator[Service]:
    """One for all tests of this folder but those that leave it full of jobs."""
    with running(tmp_path_factory.mktemp("service"), daemon_class) as one:
        yield one


@pytest.fixture(scope="package")
def done(service: Service) -> CaptureOut:
    """A capture that is over, with a recording and a reconstruction."""
    return reconstructed(service)


def reconstructed(service: Service) -> CaptureOut:
    """A capture that is over, once its reconstruction has published something."""
    capture = service.capture(name="by hand", notes="a first one")
    assert (capture.state, capture.reason) == ("complete", "")
    deadline = time.monotonic() + 60
    while service.client.reconstruction(capture.reconstruction_ids[0]).version == 0:
        assert time.monotonic() < deadline, "no version was published"
        time.sleep(0.1)
    return capture


@pytest.fixture(scope="package")
def job(done: CaptureOut) -> str:
    """The id of its reconstruction."""
    return done.reconstruction_ids[0]


def write_recording(path: Path, frames: int = 200, width: int = 96, height: int = 64) -> Sensor:
    """A simulated recording with its sidecar."""
    sensor = Sensor(width, height, 20_000.0, intrinsics=Intrinsics.from_fov(width, height, 60))
    camera = SimulatedCamera(sensor, seed=1)
    with RecordingWriter(path, sensor) as writer:
        writer.append(camera.next_frames(frames))
    return sensor
