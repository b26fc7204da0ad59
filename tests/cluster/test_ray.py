"""Jobs on a Ray cluster of this machine."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from ports import free_port
from waiting import until

from .lab import LONG, SHORT, Lab, complete

pytest.importorskip("ray", reason="needs Ray")


@pytest.fixture
def head(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a cluster with one core."""
    port = free_port()
    folder = tmp_path_factory.mktemp("ray")
    environment = os.environ | {"TEST_RAY_FOLDER": str(folder)}
    words = ["--head", f"--port={port}", "--num-cpus=1", "--include-dashboard=false", "--disable-usage-stats"]
    command = [str(Path(sys.executable).with_name("ray")), "start", *words]
    subprocess.run(command, check=True, capture_output=True, env=environment)
    yield f"127.0.0.1:{port}"
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.environ().get("TEST_RAY_FOLDER") == str(folder):
                process.kill()


@pytest.mark.slow
def test_an_actor_that_waited_while_its_engine_ended_works_for_its_attempt(
    daemon: Callable[..., Any],
    moving: Path,
    head: str,
    scratch: Path,
) -> None:
    """One that does nothing would hold its core for ever."""
    lab = Lab(daemon, moving, scratch, 30.0, engine={"executor": "ray", "executor_address": head})
    first, second = lab.submit(LONG), lab.submit(SHORT)
    lab.reached(first, lambda row: row["version"] > 0, "it has published")
    attempt = until(lambda: lab.attempt(second), "the other waits for the core")
    lab.one.process.kill()  # its engine ends with it
    lab.one.process.wait()
    until(lambda: not lab.processes("spiked_service.cluster.engines"), "the engine has ended")
    lab.start()
    lab.post(f"reconstructions/{first}:cancel")
    lab.reached(first, lambda row: row["state"] == "cancelled", "it is cancelled")
    until(lambda: lab.attempt(second) == "" or lab.job(second)["node"], "a machine has begun the other")
    assert lab.attempt(second) in ("", attempt), "it is the actor that waited"
    lab.reached(second, complete, "it is complete")
