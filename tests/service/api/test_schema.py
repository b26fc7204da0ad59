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


TRASH = "use_after_free"
"""A deleted capture can be looked at and restored until the retention takes it, and says when it was deleted."""


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
        f"positive_data_acceptance,{TRASH}",
    ]
    command += ["--seed", "1", "--request-timeout", "60", "--warnings", "off", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=1700, check=False)
    assert done.returncode == 0, done.stdout[-12_000:] + done.stderr[-2000:]


LASTING = ("--exclude-method", "DELETE")


def test_requests_about_what_there_is(service: Any, done: Any, job: str, tmp_path: Path) -> None:
    known = {"capture_id": done.id, "reconstruction_id": job, "device_id": "sim:"}
    options = ("--phases", "examples,coverage,fuzzing", "--max-examples", "5")
    fuzz(service, tmp_path / "known", known, *LASTING, *options)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_long(service: Any, done: Any, job: str, tmp_path: Path) -> None:
    known = {"capture_id": done.id, "reconstruction_id": job, "device_id": "sim:"}
    options = ("--max-examples", "200", "--max-time", "900")
    fuzz(service, tmp_path / "known", known, *LASTING, "--phases", "coverage,fuzzing", *options)
    fuzz(service, tmp_path / "random", {}, "--phases", "coverage,fuzzing,stateful", *options)
