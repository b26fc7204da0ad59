"""The running daemon against its own description: no failure of the service, no answer that is not described."""

import json
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


_ANSWER_S = 300
"""Beside other work an answer may take long; one that never comes is what shall show."""
TRASH = "use_after_free"
"""A deleted capture can be looked at and restored until the retention takes it, and says when it was deleted."""


BEYOND_SCHEMA = {
    "/api/v1/devices/{device_id}/profile": "it fits the camera, and its calibration is a file that requests may name",
    "/api/v1/captures": "a source is a small language of its own: options, files that requests may name",
    "/api/v1/captures/{capture_id}/views": "a matrix is a rotation, the sum of all pixels has a limit",
    "/api/v1/reconstructions/{reconstruction_id}/views": "a matrix is a rotation, the sum of all pixels has a limit",
    "/api/v1/reconstructions": "poses are a text of a format of their own, and what is given fits the capture",
    "/api/v1/reconstructions/{reconstruction_id}/scale:up": "points are not on a line, and a floor is not always seen",
    "/api/v1/reconstructions/{reconstruction_id}/scale:board": "the board has to be in the scene",
    "/api/v1/reconstructions/{reconstruction_id}/scale:baseline": "the paths of two cameras have to be in the map",
    "/api/v1/reconstructions/{reconstruction_id}/exports/{format}": "a frame has a pose, all pixels have a limit",
    "/api/v1/captures/{capture_id}/exports/{format}": "a frame has a pose, all pixels have a limit",
    "/api/v1/captures/{capture_id}/recording/video": "the range lies in the recording, all pixels have a limit",
    "/api/v1/uploads": "geometry and sidecar fit each other and the size, which has a limit of its own",
}
"""Where what the schema allows may be refused with 422 or 413 all the same, and why; test_rules has the other rules."""
TOO_LARGE = ("/api/v1/captures", "/api/v1/uploads")
"""Where 507 says that the disk has no room for what is asked: no failure of the service."""
OF_SOME = (
    "/api/v1/reconstructions/{reconstruction_id}/localisation",
    "/api/v1/reconstructions/{reconstruction_id}/registration",
)
"""What a new reconstruction need not have: it depends on its task, and answers 404 otherwise."""
_ACCEPTED = ["2xx", "3xx", "401", "403", "404", "409", "429", "5xx"]


def configuration(known: dict[str, str]) -> str:
    """A schemathesis.toml; ids in `known` are used instead of random ones."""
    lines = [f"hooks = {json.dumps(str(Path(__file__).with_name('schema_hooks.py')))}"]
    lines += ["[parameters]", *(f'"path.{name}" = "{value}"' for name, value in known.items())]
    for path in BEYOND_SCHEMA:
        accepted = json.dumps([*_ACCEPTED, "413", "422"])
        method = "PUT" if path.endswith("/profile") else "GET" if path.endswith(("/{format}", "/video")) else "POST"
        lines += ["[[operations]]", f'include-path = "{path}"', f'include-method = "{method}"']
        lines += [f"checks.positive_data_acceptance.expected-statuses = {accepted}"]
        if path in TOO_LARGE:
            lines += ['checks.not_a_server_error.expected-statuses = ["2xx", "3xx", "4xx", "507"]']
    for path in OF_SOME:
        lines += ["[[operations]]", f'include-path = "{path}"']
        lines += ["checks.ensure_resource_availability.enabled = false"]
    # It would change the limits of the service that answers, in the file of the user who runs the tests.
    lines += ["[[operations]]", 'include-path = "/api/v1/configuration"', 'include-method = "PATCH"', "enabled = false"]
    return "\n".join(lines) + "\n"


def fuzz(service: Any, folder: Path, known: dict[str, str], *options: str) -> None:
    """Run schemathesis until it ends by itself: how long that takes is the machine's affair."""
    folder.mkdir(exist_ok=True)
    config = folder / "schemathesis.toml"
    config.write_text(configuration(known))
    command = [str(Path(sys.executable).with_name("st")), "--config-file", str(config), "--no-color", "run"]
    # All checks by default. Named on the command line, they would outrank what `configuration` turns off.
    command += [f"{service.daemon.address}openapi.json", "--exclude-checks", TRASH]
    command += ["--seed", "1", "--request-timeout", str(_ANSWER_S), "--warnings", "off", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-12_000:] + done.stderr[-2000:]


LASTING = ("--exclude-method", "DELETE")


def test_requests_about_what_there_is(service: Any, done: Any, job: str, tmp_path: Path) -> None:
    known = {"capture_id": done.id, "reconstruction_id": job, "device_id": "sim:"}
    options = ("--phases", "examples,coverage,fuzzing,stateful", "--max-examples", "5", "--max-time", "60")
    fuzz(service, tmp_path / "known", known, *LASTING, *options)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_long(service: Any, done: Any, job: str, tmp_path: Path) -> None:
    known = {"capture_id": done.id, "reconstruction_id": job, "device_id": "sim:"}
    options = ("--max-examples", "200", "--max-time", "900")
    fuzz(service, tmp_path / "known", known, *LASTING, "--phases", "coverage,fuzzing", *options)
    fuzz(service, tmp_path / "random", {}, "--phases", "coverage,fuzzing,stateful", *options)
