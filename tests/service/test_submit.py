"""`spiked submit` and `spiked jobs` against a running service."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from spiked_service.cli.recording_uris import find
from waiting import until

from spiked.errors import ConfigurationError

from .survival import SMALL, moving_recording

SECRET = "a-token-of-a-laboratory"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two recordings, one of them deeper, and a file that is none."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "day").mkdir()
    moving_recording(folder / "a.dat")
    for suffix in (".dat", ".json"):
        shutil.copy(folder / f"a{suffix}", folder / "day" / f"b{suffix}")
    (folder / "none.dat").write_bytes(b"no frames")
    return folder


def spiked(one: Any, *words: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "spiked_service", *words, "--address", one.address]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)


def test_recordings_are_sent_and_their_jobs_are_listed(daemon: Callable[..., Any], runs: Path) -> None:
    one = daemon()
    sent = spiked(one, "submit", f"{runs}/**/[ab].dat", str(runs / "a.dat"), "--steps", "20", "--priority", "3")
    assert sent.returncode == 0, sent.stderr
    ids = [line.split()[0] for line in sent.stdout.splitlines()]
    assert [line.split()[1].rpartition("/")[2] for line in sent.stdout.splitlines()] == ["a.dat", "b.dat"]
    until(
        lambda: all(one.http.get(f"reconstructions/{job}").json()["state"] == "complete" for job in ids),
        "both are done",
    )
    jobs = [json.loads(line) for line in spiked(one, "jobs", "--json").stdout.splitlines()]
    assert [job["id"] for job in jobs] == ids[::-1]
    assert {(job["options"]["steps"], job["priority"]) for job in jobs} == {(20, 3)}
    capture = one.http.get(f"captures/{jobs[0]['capture_id']}").json()
    assert capture["name"] == "b.dat" and capture["notes"] == f"file://{runs}/day/b.dat"
    table = spiked(one, "jobs", "--state", "complete").stdout
    assert all(job in table for job in ids) and "b.dat" in table and "100 %" in table
    assert "no such jobs" in spiked(one, "jobs", "--state", "running").stderr


def test_a_recording_that_is_none_does_not_hold_up_the_others(daemon: Callable[..., Any], runs: Path) -> None:
    one = daemon()
    sent = spiked(one, "submit", str(runs / "none.dat"), str(runs / "a.dat"), "--steps", "200000")
    assert sent.returncode == 1
    assert "none.dat: " in sent.stderr and "1 of 2 recordings were not queued" in sent.stderr
    (job,) = [line.split()[0] for line in sent.stdout.splitlines()]
    ended = spiked(one, "jobs", "cancel", job)
    assert ended.returncode == 0, ended.stderr
    until(lambda: one.http.get(f"reconstructions/{job}").json()["state"] == "cancelled", "it is cancelled")


def test_a_token_is_read_from_a_file(daemon: Callable[..., Any], tmp_path: Path) -> None:
    one = daemon("--token", SECRET, "--set", "require_token=true", token=SECRET)
    refused = spiked(one, "jobs")
    assert refused.returncode == 2 and "requires a token" in refused.stderr
    secret = tmp_path / "secret"
    assert "cannot read the token" in spiked(one, "jobs", "--token-file", str(secret)).stderr
    for content in ("", f"{SECRET}\nand another\n"):
        secret.write_text(content)
        assert "does not hold a token" in spiked(one, "jobs", "--token-file", str(secret)).stderr
    secret.write_text(f"{SECRET}\n")
    assert spiked(one, "jobs", "--token-file", str(secret)).returncode == 0
    assert "give one of them" in spiked(one, "jobs", "--token", "x", "--token-file", str(secret)).stderr


@pytest.mark.parametrize(
    ("environment", "works"),
    [
        ({}, False),
        ({"SPIKED_CLIENT_TOKEN": SECRET}, True),
        ({"SPIKED_TOKEN": SECRET}, True),
        ({"SPIKED_TOKEN_FILE": "the file"}, True),
        ({"SPIKED_TOKEN": "of-another-service", "SPIKED_CLIENT_TOKEN": SECRET}, True),
        ({"SPIKED_TOKEN": SECRET, "SPIKED_CLIENT_TOKEN": ""}, True),
        ({"SPIKED_TOKEN": "of-another-service"}, False),
    ],
)
def test_commands_find_service_and_token_in_the_environment(
    daemon: Callable[..., Any], tmp_path: Path, environment: dict[str, str], works: bool
) -> None:
    one = daemon("--no-capture", "--device", SMALL, "--token", SECRET, "--set", "require_token=true", token=SECRET)
    (tmp_path / "token").write_text(SECRET)
    given = {name: value.replace("the file", str(tmp_path / "token")) for name, value in environment.items()}
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SPIKED_")}
    for words in (("jobs",), ("record", SMALL, "--frames", "10")):
        done = subprocess.run(
            [sys.executable, "-m", "spiked_service", *words],
            env={**kept, "SPIKED_ADDRESS": one.address, **given},
            capture_output=True,
            text=True,
            check=False,
            timeout=240,
        )
        assert (done.returncode == 0) == works, done.stderr
        assert works or "token" in done.stderr


def test_names_of_nothing_are_said(tmp_path: Path) -> None:
    for name in ("missing.dat", "*.dat"):
        with pytest.raises(ConfigurationError, match="names no file"):
            find([str(tmp_path / name)])
    with pytest.raises(ConfigurationError, match="cannot be looked at"):
        find(["nope://bucket/a.dat"])


def test_a_recording_of_a_store_is_read_from_there() -> None:
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.pipe_file("/runs/a.dat", b"0123456789")
    memory.pipe_file("/runs/a.json", b"{}")
    (one,) = find(["memory://runs/*.dat"])
    assert (one.name, one.size, one.sidecar()) == ("a.dat", 10, b"{}")
    with one.open() as file:
        file.seek(4)
        assert file.read(3) == b"456"
