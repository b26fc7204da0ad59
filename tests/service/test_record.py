"""`spiked record`: devices of a running service, started together, with the offsets of their clocks."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from click.testing import Result
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.client import ApiError
from spiked.errors import ConfigurationError
from spiked.recording import open_recording


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["record", *map(str, arguments)])


def test_devices_are_recorded_together(daemon: Callable[..., Any], tmp_path: Path) -> None:
    one = daemon("--no-capture", "--device", "sim:")
    both = [f"sim:?width=64&height=48&rate=1000&pace=1&seed={seed}" for seed in (1, 2)]
    done = run(*both, "--seconds", "1", "--name", "pair", "-o", tmp_path / "pair", "--address", one.address)
    assert done.exit_code == 0, (done.output, done.exception)
    assert len(re.findall(r"good, 1,000 of 1,000 frames, 0 lost", done.output)) == 2
    assert re.search(r"begins [+-][\d.]+( \+- [\d.]+)? us after sim:", done.output)
    files = sorted((tmp_path / "pair").glob("*.dat"))
    assert [file.name for file in files] == ["1-sim_.dat", "2-sim_.dat"]
    assert all(open_recording(file).frames == 1000 for file in files)
    items = one.http.get("captures").json()["items"]
    assert len({item["group"] for item in items}) == 1 and {item["name"][:4] for item in items} == {"pair"}

    alone = run(both[0], "--frames", "100", "--address", one.address)
    assert alone.exit_code == 0 and "good, 100 of 100 frames, 0 lost" in alone.output
    assert "begins" not in alone.output

    words = ["-m", "spiked_service", "record", *both, "--address", one.address]
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True) as unlimited:
        while len(one.http.get("captures?state=streaming").json()["items"]) < 2:
            assert unlimited.poll() is None
            time.sleep(0.1)
        unlimited.terminate()
        said, _ = unlimited.communicate()
    assert unlimited.returncode == 0 and len(re.findall(r"good, [\d,]+ frames, 0 lost", said)) == 2

    refused = run("sim:", "replay:nothing.dat", "--seconds", "1", "--address", one.address)
    assert isinstance(refused.exception, ApiError) and "nothing.dat" in str(refused.exception)
    assert isinstance(run("sim:", "--seconds", "1", "--frames", "5").exception, ConfigurationError)


def test_a_recording_without_a_frame_is_not_called_complete(daemon: Callable[..., Any], tmp_path: Path) -> None:
    one = daemon("--no-capture", "--device", "sim:")
    words = ["-m", "spiked_service", "record", "sim:?width=64&height=48&rate=1000&pace=1", f"pcie:{tmp_path}/absent"]
    command = [sys.executable, *words, "--address", one.address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as both:
        assert both.stderr is not None
        assert any("absent waits: " in line for line in both.stderr), "it ends only when it is told to"
        while {item["state"] for item in one.http.get("captures").json()["items"]} != {"streaming", "waiting"}:
            assert both.poll() is None
            time.sleep(0.1)
        both.send_signal(signal.SIGINT)
        said, _ = both.communicate()
    assert re.search(r"^sim:.*, good, [\d,]+ frames, 0 lost$", said, re.M)
    assert re.search(r"^pcie:.*, bad, 0 frames, 0 lost; .*absent", said, re.M) and "complete" not in said
    assert both.returncode == 1


def test_a_token_may_come_from_a_file(daemon: Callable[..., Any], tmp_path: Path) -> None:
    one = daemon("--no-capture", "--device", "sim:", "--token", "open-sesame-0123456789")
    source = "sim:?width=64&height=48&rate=1000&pace=1"
    file = tmp_path / "token"
    file.write_text("open-sesame-0123456789\n")
    done = run(source, "--frames", "100", "--address", one.address, "--token-file", file)
    assert done.exit_code == 0 and "good, 100 of 100 frames, 0 lost" in done.output
    assert isinstance(run(source, "--frames", "100", "--address", one.address).exception, ApiError)
    both = run(source, "--frames", "5", "--token", "a", "--token-file", file)
    assert isinstance(both.exception, ConfigurationError)
