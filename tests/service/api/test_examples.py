"""The examples of docs/api.md, run as they stand but for the address."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
DOCUMENT = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
NODE_MODULES = Path(os.environ.get("NODE_MODULES", ROOT / "web" / "node_modules"))


def blocks(language: str, address: str) -> list[str]:
    """The fenced blocks of a language, for this daemon."""
    found = re.findall(rf"^```{language}\n(.*?)^```", DOCUMENT, re.MULTILINE | re.DOTALL)
    assert found
    return [block.replace("http://127.0.0.1:8650", address.rstrip("/")) for block in found]


def run(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def test_curl(daemon: Callable[..., Any], tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        pytest.skip("needs curl")
    script = "set -euo pipefail\n" + "\n".join(blocks("sh", daemon().address))
    run(["bash", "-c", script], tmp_path)
    for name, magic in {
        "seen.png": b"\x89PNG",
        "view.webp": b"RIFF",
        "depth.exr": b"v/1\x01",
        "path.zip": b"PK",
    }.items():
        assert (tmp_path / name).read_bytes().startswith(magic)
    assert (tmp_path / "first-frame.bin").stat().st_size == 2000


def test_python(daemon: Callable[..., Any], tmp_path: Path) -> None:
    first, follow, edit, second, frames = blocks("python", daemon().address)
    told = run([sys.executable, "-c", first], tmp_path)
    assert "the camera went" in told and "422" in told
    came = run([sys.executable, "-c", follow], tmp_path).splitlines()
    assert " 0 splats came" not in came[0] and " 0 splats came" in came[-1], came
    edited = run([sys.executable, "-c", edit], tmp_path).splitlines()
    assert edited[0].endswith(" floaters") and edited[1] == "2.11 m a unit" and len(edited) == 3, edited
    poses = run([sys.executable, "-c", second], tmp_path).splitlines()
    assert len(poses) > 10, poses
    assert run([sys.executable, "-c", frames], tmp_path).splitlines()[-1].startswith("finished ")


def test_javascript(daemon: Callable[..., Any], tmp_path: Path) -> None:
    if shutil.which("node") is None:
        pytest.skip("needs Node")
    (script,) = blocks("js", daemon().address)
    (tmp_path / "example.mjs").write_text(script)
    told = run(["node", "example.mjs"], tmp_path)
    assert "poses, the first at" in told and "image/jpeg" in told


def test_typescript_checks_and_runs(daemon: Callable[..., Any], tmp_path: Path) -> None:
    tools = {name: NODE_MODULES / ".bin" / name for name in ("tsc", "openapi-typescript")}
    if not all(tool.exists() for tool in tools.values()) or not (NODE_MODULES / "openapi-fetch").is_dir():
        pytest.skip(f"needs typescript, openapi-typescript and openapi-fetch in {NODE_MODULES}")
    one = daemon()
    one.http.post("captures", json={"source": "sim:?width=96&height=64", "frames": 64, "reconstruct": False})
    (script,) = blocks("ts", one.address)
    (tmp_path / "node_modules").symlink_to(NODE_MODULES)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "example.ts").write_text(script)
    run([str(tools["openapi-typescript"]), f"{one.address}openapi.json", "-o", "schema.d.ts"], tmp_path)
    options = [
        "--strict",
        "--target",
        "es2022",
        "--module",
        "esnext",
        "--moduleResolution",
        "bundler",
        "--lib",
        "es2022,dom",
    ]
    run([str(tools["tsc"]), *options, "--skipLibCheck", "--typeRoots", "none", "example.ts"], tmp_path)
    assert one.http.get("captures").json()["items"][0]["id"] in run(["node", "example.js"], tmp_path)
