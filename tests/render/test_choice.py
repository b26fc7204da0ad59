"""Which rasteriser one gets, and what is said of it where a GPU is there and cannot be used."""

import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import render_scenes as scenes

from spiked.errors import ConfigurationError
from spiked.render import Rasteriser, choice, gpu, rasteriser_for

MACHINE = """
from pathlib import Path
from spiked.render import choice
choice.DRIVER = Path({driver!r})
from spiked_service.cli.main import main
main()
"""
"""A process that sees an NVIDIA driver, and no device."""


@pytest.fixture(autouse=True)
def afresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing is asked for, and what was found before is forgotten."""
    monkeypatch.delenv("SPIKED_RENDER", raising=False)
    choice.choice_for.cache_clear()
    yield
    choice.choice_for.cache_clear()


@pytest.fixture
def driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with an NVIDIA driver, whose GPU, if it has one, is hidden."""
    if not gpu.missing():
        pytest.skip("this process has seen a GPU that can be used")
    file = tmp_path / "version"
    file.write_text("NVRM version: NVIDIA UNIX x86_64 Kernel Module\n")
    monkeypatch.setattr(choice, "DRIVER", file)
    return file


def command(driver: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """`spiked` on that machine."""
    return subprocess.run(
        [sys.executable, "-c", MACHINE.format(driver=str(driver)), *arguments],
        env={**os.environ, "COLUMNS": "300", **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_the_cpu_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_RENDER", "cpu")
    assert isinstance(rasteriser_for(scenes.camera(), 1), Rasteriser)


def test_the_best_one_without_asking() -> None:
    best = Rasteriser if gpu.missing() else gpu.GpuRasteriser
    assert isinstance(rasteriser_for(scenes.camera(), 1), best)


def test_a_wish_that_cannot_be_met_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_RENDER", "abacus")
    with pytest.raises(ConfigurationError, match="abacus"):
        rasteriser_for(scenes.camera(), 1)
    if gpu.missing():
        monkeypatch.setenv("SPIKED_RENDER", "cuda")
        with pytest.raises(ConfigurationError, match="GPU"):
            rasteriser_for(scenes.camera(), 1)


def test_a_gpu_that_cannot_be_used_gives_way_to_the_cpu(
    driver: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "spiked.render"):
        for _ in range(2):
            assert type(rasteriser_for(scenes.camera(), 1)) is Rasteriser
    (line,) = caplog.records  # once a process
    assert "CUDA" in line.getMessage()
    monkeypatch.setenv("SPIKED_RENDER", "cuda")
    with pytest.raises(ConfigurationError, match="cannot render on a GPU"):
        rasteriser_for(scenes.camera(), 1)


def test_commands_say_why_the_gpu_is_not_used(driver: Path) -> None:
    told = command(driver, "version")
    assert told.returncode == 0, told.stderr
    assert "renderer: cpu (" in told.stdout and "CUDA" in told.stdout
    found = json.loads(command(driver, "devices", "--doctor", "--json").stdout)
    (renderer,) = (finding for finding in found if finding["name"] == "renderer")
    assert renderer["status"] == "warning" and renderer["finding"].startswith("cpu: ")
    assert "SPIKED_RENDER=cpu" in renderer["what_to_do"]
    shown = command(driver, "config", "show", SPIKED_RENDER="cpu")
    assert "renderer: cpu (SPIKED_RENDER asks for it)" in shown.stdout, shown.stderr
    wanted = command(driver, "devices", "--doctor", "--json", SPIKED_RENDER="cuda")
    (renderer,) = (finding for finding in json.loads(wanted.stdout) if finding["name"] == "renderer")
    assert (wanted.returncode, renderer["status"]) == (1, "problem")


def test_a_reconstruction_goes_on_with_the_cpu(driver: Path, tmp_path: Path) -> None:
    simulated = command(driver, "simulate", "-o", str(tmp_path / "room"), "--motion", "arc", "--frames", "320")
    assert simulated.returncode == 0, simulated.stderr
    recording = str(tmp_path / "room" / "simulated.dat")
    done = command(driver, "reconstruct", recording, "-o", str(tmp_path / "out"), "--steps", "20")
    assert done.returncode == 0, done.stderr
    assert "CUDA" in done.stderr
    assert (tmp_path / "out" / "scene.ply").stat().st_size > 1000
