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
from test_cuda import small_rasterisation

from spiked.errors import ConfigurationError
from spiked.render import Rasteriser, choice, cuda, rasteriser_for

WITHOUT_TOOLKIT = Path(__file__).parent / "without_toolkit"
MACHINE = """
import sys
from pathlib import Path
import torch
from spiked.render import choice, cuda
choice.DRIVER = Path({driver!r})
torch.cuda.is_available = lambda: True
cuda.DEVICE = "cpu"
from spiked_service.cli.main import main
main()
"""
"""A process that sees an NVIDIA driver and a device of torch, which is the CPU."""


@pytest.fixture(autouse=True)
def afresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing is asked for, and what was found before is forgotten."""
    monkeypatch.delenv("SPIKED_RENDER", raising=False)
    for known in (choice.choice_for, cuda.trial):
        known.cache_clear()
    yield
    for known in (choice.choice_for, cuda.trial):
        known.cache_clear()


@pytest.fixture
def driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with an NVIDIA driver and a device that torch sees; the device is this machine's CPU."""
    file = tmp_path / "version"
    file.write_text("NVRM version: NVIDIA UNIX x86_64 Kernel Module\n")
    monkeypatch.setattr(choice, "DRIVER", file)
    monkeypatch.setattr(cuda.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    return file


def command(driver: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """`spiked` on that machine, with a gsplat without kernels on the path."""
    return subprocess.run(
        [sys.executable, "-c", MACHINE.format(driver=str(driver)), *arguments],
        env={**os.environ, "PYTHONPATH": str(WITHOUT_TOOLKIT), "COLUMNS": "300", **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_the_cpu_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_RENDER", "cpu")
    assert isinstance(rasteriser_for(scenes.camera(), 1), Rasteriser)


def test_the_best_one_without_asking() -> None:
    best = Rasteriser if cuda.missing() else cuda.CudaRasteriser
    assert isinstance(rasteriser_for(scenes.camera(), 1), best)


def test_a_wish_that_cannot_be_met_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_RENDER", "abacus")
    with pytest.raises(ConfigurationError, match="abacus"):
        rasteriser_for(scenes.camera(), 1)
    if cuda.missing():
        monkeypatch.setenv("SPIKED_RENDER", "cuda")
        with pytest.raises(ConfigurationError, match="GPU"):
            rasteriser_for(scenes.camera(), 1)


def test_kernels_that_render_are_chosen(driver: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(WITHOUT_TOOLKIT))
    import gsplat

    monkeypatch.setattr(gsplat, "rasterization", small_rasterisation)
    assert choice.chosen().renderer == "cuda"
    assert isinstance(rasteriser_for(scenes.camera(), 1), cuda.CudaRasteriser)


def test_gsplat_without_kernels_gives_way_to_the_cpu(
    driver: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.syspath_prepend(str(WITHOUT_TOOLKIT))
    with caplog.at_level(logging.WARNING, "spiked.render"):
        for _ in range(2):
            assert isinstance(rasteriser_for(scenes.camera(), 1), Rasteriser)
    (line,) = caplog.records  # once a process
    assert "NoneType" in line.getMessage() and "CUDA toolkit" in line.getMessage()
    monkeypatch.setenv("SPIKED_RENDER", "cuda")
    with pytest.raises(ConfigurationError, match="CUDA toolkit"):
        rasteriser_for(scenes.camera(), 1)


def test_commands_say_why_the_gpu_is_not_used(driver: Path) -> None:
    told = command(driver, "version")
    assert told.returncode == 0, told.stderr
    assert "renderer: cpu (" in told.stdout and "CUDA toolkit" in told.stdout
    found = json.loads(command(driver, "devices", "--doctor", "--json").stdout)
    (renderer,) = (finding for finding in found if finding["name"] == "renderer")
    assert renderer["status"] == "warning" and renderer["finding"].startswith("cpu: gsplat")
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
    assert "CUDA toolkit" in done.stderr
    assert (tmp_path / "out" / "scene.ply").stat().st_size > 1000
