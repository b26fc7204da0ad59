"""An S3 server of this machine, a recording, and a service whose jobs run elsewhere."""

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

from .lab import LEASE_S, Lab


@pytest.fixture(scope="session")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a camera that moves."""
    path = tmp_path_factory.mktemp("recordings") / "moving.dat"
    sensor = Sensor(160, 96, 20_000.0, intrinsics=Intrinsics.from_fov(160, 96, 60))
    camera = SimulatedCamera(sensor, seed=4, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    with RecordingWriter(path, sensor) as writer:
        writer.append(camera.next_frames(500))
    return path


@pytest.fixture
def scratch(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the agents of this test."""
    folder = tmp_path_factory.mktemp("scratch")
    monkeypatch.setenv("SPIKED_SCRATCH", str(folder))
    return folder


@pytest.fixture(scope="session")
def bucket() -> Iterator[str]:
    """The URI of a bucket of a server of this process, whose address is in the environment."""
    pytest.importorskip("s3fs", reason="needs s3fs")
    server_module = pytest.importorskip("moto.server", reason="needs moto[server]")
    server = server_module.ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    with pytest.MonkeyPatch.context() as patch:
        host, port = server.get_host_and_port()
        for name in [name for name in os.environ if name.startswith("AWS_")]:
            patch.delenv(name)
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "nobody")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import s3fs

        s3fs.S3FileSystem().mkdir("spiked-test")
        yield "s3://spiked-test"
        s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


@pytest.fixture
def elsewhere() -> dict[str, Any]:
    """Further arguments of the lab: where its agents are."""
    return {}


@pytest.fixture
def lab(
    request: pytest.FixtureRequest,
    daemon: Callable[..., Any],
    moving: Path,
    scratch: Path,
    elsewhere: dict[str, Any],
) -> Iterator[Lab]:
    """A lab; its parameter is the lease in seconds."""
    one = Lab(daemon, moving, scratch, getattr(request, "param", LEASE_S), **elsewhere)
    yield one
    for process in one.agents():
        with suppress(psutil.Error):
            process.kill()
