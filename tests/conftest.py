"""What several folders of tests share: the data beside the repository, and the daemon as a process."""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import psutil
import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"
START_S = 60.0


class Daemon:
    """`spiked serve` as a process of its own, and a client to talk to it."""

    def __init__(self, *arguments: str, runtime: Path, token: str | None = None) -> None:
        command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--runtime", str(runtime)]
        self.process = subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.output = self.process.stdout
        line = self.output.readline()
        found = re.search(r"http://\S+", line)
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
                if words[1:3] == ["-m", "spiked_service.worker"]:
                    found[words[3]] = child
        return found

    def close(self) -> None:
        """End it, whatever it is doing."""
        self.http.close()
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait(START_S)
        self.output.close()


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Callable[..., Daemon]]:
    """Starts daemons with the given arguments, and ends them after the test."""
    started: list[Daemon] = []

    def start(*arguments: str, token: str | None = None) -> Daemon:
        started.append(Daemon(*arguments, runtime=tmp_path / "runtime", token=token))
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
