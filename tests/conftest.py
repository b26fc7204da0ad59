"""What several folders of tests share: the data beside the repository, and the daemon as a process."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
import pytest

sys.path.append(str(Path(__file__).parent))  # pytest's importlib mode adds no folder by itself
sys.path.append(str(Path(__file__).parent / "usb"))
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras, missing
from virtual_camera.stream import COMPACT_BYTES

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a shell: commands that tests start would inherit that, and never hear of Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(__file__).resolve().parents[2] / "shared"
START_S = 60.0


class Daemon:
    """`spiked serve` as a process of its own, and a client to talk to it."""

    def __init__(
        self,
        *arguments: str,
        folder: Path,
        token: str | None = None,
        seen: VirtualCameras | None = None,
        under: tuple[str, ...] = (),
    ) -> None:
        self.data = folder / "data"
        command = [*under, sys.executable, "-m", "spiked_service", "serve", "--port", "0"]
        command += ["--runtime", str(folder / "runtime"), "--data", str(self.data)]
        command += ["--set", f"source_folders={folder.parent}"]
        self.process = subprocess.Popen(
            [*command, *arguments], stdout=subprocess.PIPE, text=True, env=seen and seen.environment
        )
        assert self.process.stdout is not None
        self.output = self.process.stdout
        line = self.output.readline()
        found = re.search(r"https?://\S+", line)
        assert found, f"no address in {line!r}"
        self.address = found[0]
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self.http = httpx.Client(base_url=f"{self.address}api/v1", timeout=START_S, headers=headers)

    def workers(self) -> dict[str, psutil.Process]:
        """Its living worker processes by role."""
        found = {}
        for child in psutil.Process(self.process.pid).children():
            with suppress(psutil.NoSuchProcess):
                words = child.cmdline()  # empty for a zombie, and without the role just after a fork
                if "spiked_service.workers" in words[1:-1]:
                    found.setdefault(words[-1], child)  # the oldest: a spare recorder stands by
        return found

    def close(self) -> None:
        """End it, whatever it is doing."""
        self.http.close()
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait(START_S)
        self.output.close()


@pytest.fixture(scope="session", autouse=True)
def home_of_nobody(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Settings and captures of the user who runs the tests are neither read nor changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("settings")))
        patch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("data")))
        yield


@pytest.fixture(scope="session")
def daemon_class() -> type[Daemon]:
    """For fixtures that keep a daemon for more than one test."""
    return Daemon


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Callable[..., Daemon]]:
    """Starts daemons with the given arguments, and ends them after the test.

    `seen` are cameras that they find, `under` is a command that starts another, as `nice` does.
    """
    started: list[Daemon] = []

    def start(*arguments: str, **more: Any) -> Daemon:
        started.append(Daemon(*arguments, folder=tmp_path, **more))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.fixture
def shared() -> Path:
    """The data folder beside the repository."""
    if not SHARED.is_dir():
        pytest.skip(f"there is no data folder {SHARED}")
    return SHARED


@pytest.fixture
def cameras() -> Iterator[Callable[..., VirtualCameras]]:
    """Makes machines with virtual cameras: `cameras(CameraSettings(...), ..., usbfs_memory_mb=16)`."""
    if reason := missing():
        pytest.skip(reason)
    made: list[VirtualCameras] = []

    def make(*settings: CameraSettings, **machine: Any) -> VirtualCameras:
        made.append(VirtualCameras(settings, **machine))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """200 compact 400x250 frames of noise in a file, all different."""
    path = tmp_path_factory.mktemp("pictures") / "noise.dat"
    np.random.default_rng(3).integers(0, 256, (200, COMPACT_BYTES), np.uint8).tofile(path)
    return path


_FIGURES = pytest.StashKey[list[tuple[str, str, str]]]()


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Callable[[str, object, str], None]:
    """Notes a figure of the validation list, `figure(what, value, bound)`, to be printed when all tests have run."""
    figures = request.config.stash.setdefault(_FIGURES, [])
    return lambda what, value, bound: figures.append((what, str(value), bound))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print the figures of the validation list."""
    figures = config.stash.get(_FIGURES, [])
    if figures:
        terminalreporter.section("validation")
    for what, value, bound in figures:
        terminalreporter.write_line(f"{what:58s} {value:>16s}   ({bound})")


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    """A folder whose file system takes direct writes."""
    try:
        os.close(os.open(tmp_path / "try", os.O_WRONLY | os.O_CREAT | os.O_DIRECT))
    except OSError as error:
        pytest.skip(f"the file system of {tmp_path} takes no direct writes: {error.strerror}")
    return tmp_path
