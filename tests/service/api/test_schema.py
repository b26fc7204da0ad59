"""The running daemon against its own description: no failure of the service, no answer that is not described."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from .conftest import Service, reconstructed, running


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, daemon_class: Any) -> Iterator[Service]:
    """A daemon of its own: it is left with jobs that nobody else shall wait behind."""
    with running(tmp_path_factory.mktemp("fuzzed"), daemon_class) as one:
        yield one


@pytest.fixture(scope="module")
def done(service: Service) -> Any:
    """A capture in it that is over, with a reconstruction."""
    return reconstructed(service)


@pytest.fixture(scope="module")
def job(done: Any) -> str:
    """The id of its reconstruction."""
    return str(done.reconstruction_ids[0])


def fuzz(service: Any, folder: Path, known: dict[str, str], *options: str) -> None:
    """Run schemathesis; ids in `known` are used instead of random ones."""
    folder.mkdir(exist_ok=True)
    lines = [f'"path.{name}" = "{value}"' for name, value in known.items()]
    config = folder / "schemathesis.toml"
    config.write_text("[parameters]\n" + "\n".join(lines) + "\n")
    command = [str(Path(sys.executable).with_name("st")), "--config-file", str(config), "--no-color", "run"]
    command += [
        f"{service.daemon.address}openapi.json",
        "--checks",
        "all",
        "--exclude-checks",
        "positive_data_acceptance",
    ]
    command += ["--seed", "1", "--request-timeout", "60", "--warnings", "off", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=3000, check=False)
    assert done.returncode == 0, done.stdout[-12_000:] + done.stderr[-2000:]


# Captures of the simulated camera that a fuzzer would start by the hundred are left to the examples.
QUIET = ("--exclude-operation-id", "start_capture", "--exclude-operation-id", "arm_device")
LASTING = ("--exclude-method", "DELETE")


def test_requests_about_what_there_is(service: Any, done: Any, job: str, tmp_path: Path) -> None:
    known = {"capture_id": done.id, "reconstruction_id": job, "device_id": "sim:"}
    options = ("--phases", "examples,coverage,fuzzing", "--max-examples", "5")
    fuzz(service, tmp_path / "known", known, *QUIET, *LASTING, *options)


@pytest.mark.slow
def test_long(service: Any, done: Any, job: str, tmp_path: Path) -> None:
    known = {"capture_id": done.id, "reconstruction_id": job, "device_id": "sim:"}
    fuzz(service, tmp_path / "known", known, *QUIET, *LASTING, "--phases", "coverage,fuzzing", "--max-examples", "200")
    fuzz(service, tmp_path / "random", {}, *QUIET, "--phases", "coverage,fuzzing,stateful", "--max-examples", "200")
