"""The NEON kernels, compiled for and run on an emulated processor, against those of this machine."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from spiked.blocks import aligned_window
from spiked.pose import exp_so3
from spiked.render import Camera, Rasteriser
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor

HERE = Path(__file__).parent
NATIVE = HERE.parents[1] / "spiked" / "native"
COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which(COMPILER) is None or shutil.which(EMULATOR) is None,
        reason=f"needs {COMPILER} and {EMULATOR} (apt install g++-aarch64-linux-gnu qemu-user)",
    ),
]


def build(target: Path, main: str, kernels: str, *sources: str) -> None:
    """Compile a program with a folder's kernels for NEON and for the baseline, as CMake's spiked_kernels() does."""
    options = ["-std=c++17", "-O2", "-static", "-pthread", "-ffp-contract=fast", "-fno-math-errno", "-Wall", "-Werror"]
    objects = []
    for level in ("neon", "baseline"):
        objects.append(target.with_suffix(f".{level}.o"))
        names = [f"-DSPIKED_INSTRUCTION_SET={level}", f"-DSPIKED_{level.upper()}=1"]
        source = NATIVE / kernels / "kernels.cpp"
        subprocess.run([COMPILER, *options, *names, "-c", source, "-o", objects[-1]], check=True)
    others = [NATIVE / name for name in sources]
    subprocess.run([COMPILER, *options, HERE / main, *others, *objects, "-o", target], check=True)


def emulate(*command: str | Path) -> str:
    return subprocess.run([EMULATOR, *command], check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.parametrize("level", ["neon", "baseline"])
@pytest.mark.parametrize("colours", [1, 3])
def test_renders_and_gradients(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, level: str, colours: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path_factory.getbasetemp() / "render_once"
    if not program.exists():
        build(program, "render_once.cpp", "raster", "raster/renderer.cpp", "raster/dispatch.cpp", "common/pool.cpp")
    rng = np.random.default_rng(colours)
    n, width, height = 300, 83, 61
    camera = Camera(Intrinsics(70, 72, 41, 30), width, height)
    z = rng.uniform(1, 3, n)
    splats = Scene(
        np.stack([rng.uniform(-0.6, 0.6, n) * z, rng.uniform(-0.5, 0.5, n) * z, z], 1).astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        (np.log(0.05) + rng.normal(0, 0.5, (n, 3))).astype(np.float32),
        rng.normal(0.3, 1.5, n).astype(np.float32),
        rng.uniform(0.1, 1, (n, colours)).astype(np.float32),
    )
    rotations = np.stack([exp_so3(np.array([0.01, -0.02, 0.01]) * k) for k in range(3)])
    centres = rng.normal(0, 0.01, (3, 3))
    windows = np.sort(rng.uniform(0, 2, (2, height, width)), 0).astype(np.float32)
    d_values = rng.normal(size=(height, width) if colours == 1 else (height, width, 3)).astype(np.float32)

    k = camera.intrinsics
    parts = [
        np.array([n, colours, width, height, 3], np.int32),
        np.array([k.fx, k.fy, k.cx, k.cy, 0.01], np.float32),
        *(splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.colours),
        *(windows, d_values, rotations, centres),
    ]
    (tmp_path / "in").write_bytes(b"".join(part.tobytes() for part in parts))
    monkeypatch.setenv("QEMU_SET_ENV", f"SPIKED_SIMD={level}")
    assert emulate(program, tmp_path / "in", tmp_path / "out") == level
    monkeypatch.delenv("QEMU_SET_ENV")

    rasteriser = Rasteriser(camera, 1)
    image = rasteriser.forward_moving(splats, rotations, centres, windows, background=0.1)
    gradients = rasteriser.backward(d_values)
    got = (tmp_path / "out").read_bytes()
    named = {"values": image.values} | {
        name: getattr(gradients, name)
        for name in ("means", "quats", "log_scales", "opacity_logits", "colours", "rotation", "centre")
    }
    for name, here in named.items():
        there = np.frombuffer(got[: here.nbytes], here.dtype).reshape(here.shape)
        got = got[here.nbytes :]
        assert np.linalg.norm(there - here) <= 1e-5 * np.linalg.norm(here), name
    assert not got


def test_aligned_windows(tmp_path: Path) -> None:
    build(tmp_path / "window_once", "window_once.cpp", "spikes")
    sensor = Sensor(400, 250, 20_000.0, flipped=False)
    frames = np.random.default_rng(0).integers(0, 256, (40, sensor.frame_bytes), np.uint8)
    frames &= np.random.default_rng(1).integers(0, 256, frames.shape, np.uint8)
    (tmp_path / "in").write_bytes(frames.tobytes())
    program, numbers = tmp_path / "window_once", ("400", "250", "40", "13", "27")
    assert emulate(program, *numbers, tmp_path / "in", tmp_path / "out") == "neon"
    here = aligned_window(frames, sensor, 0, 13, 27)
    there = np.frombuffer((tmp_path / "out").read_bytes(), np.uint16).reshape(4, 250, 400)
    for a, b in zip(there, (here.spikes, here.start_offset, here.stop_offset, here.count), strict=True):
        assert (a == b).all()
