"""Compare the map of a live capture through a capture card with that of the same frames in a file.

    .venv/bin/python evaluation/measure_card_quality.py STREAM_DIR [--steps 2000] [--rate 30] [--page PICTURE.png]

STREAM_DIR: a 1000x1000 stream with truth, as `spiked simulate` writes it. The virtual card of tests writes its frames
once into a pipe, at `--rate` frames a second so that the tracker need not skip any; a daemon captures from it as
`pcie:PIPE` with live reconstruction. The same frames are reconstructed from the file with the same number of steps.
Both results are scored by `spiked evaluate`. `--page` keeps a picture of the page that shows the live job's scene.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np
from measure_card import serving
from measure_live import FLAGS

from spiked.client import Spiked
from spiked.recording import open_recording

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from virtual_card import virtual_card

SPIKED = Path(sys.executable).with_name("spiked")
PATIENCE_S = 1800.0
SETTLES_MS = 20_000
"""Until a scene is fetched and drawn by software."""
SHOWN = ("coverage", "ate_percent", "rpe_r_deg", "psnr_db", "worst_psnr_db", "ssim")


def live(recording: Path, out: Path, steps: int, rate: float, page: Path | None) -> tuple[bool, int]:
    """Write trajectory and scene of the live job into `out`; whether the recording is bit-exact, and frames tracked."""
    whole = open_recording(recording)
    sensor = whole.sensor
    assert sensor.intrinsics is not None and sensor.mosaic is not None
    k = sensor.intrinsics
    options = f"mosaic={sensor.mosaic}&flipped={str(sensor.flipped).lower()}"
    options += f"&intrinsics={k.fx},{k.fy},{k.cx},{k.cy}&rate={sensor.frame_rate_hz:g}"
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        pipe, frames = Path(folder) / "card", Path(folder) / "frames"
        os.mkfifo(pipe)
        compact = whole.compact(0, whole.frames)
        compact.tofile(frames)
        source = f"pcie:{pipe}?{options}"
        with serving(Path(folder), source) as address, Spiked(address) as client:
            started = httpx.post(
                f"{address}/api/v1/captures", json={"source": source, "options": {"steps": steps}}, timeout=60
            )
            started.raise_for_status()
            capture_id = started.json()["id"]
            with virtual_card(frames, pipe, rate=rate):
                capture = client.wait_for_capture(capture_id, PATIENCE_S)
            job = capture.reconstruction_ids[0]
            done = client.wait_for_reconstruction(job, PATIENCE_S)
            print(f"live job: {done.state}, {done.reason}", file=sys.stderr)
            (out / "trajectory.tum").write_bytes(client.trajectory_file(job))
            (out / "scene.ply").write_bytes(client.scene(job))
            if page is not None:
                look(f"{address}/?page=scene&capture={capture_id}", page)
            stored = client.save_recording(capture_id, Path(folder) / "stored.dat")
            same = np.array_equal(np.fromfile(stored, np.uint8), compact.reshape(-1))
            return same, done.poses


def look(address: str, picture: Path) -> None:
    """Keep a picture of a page that draws a scene."""
    from playwright.sync_api import sync_playwright

    with (
        sync_playwright() as driver,
        driver.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS) as browser,
    ):
        shown = browser.new_page(viewport={"width": 1400, "height": 900})
        shown.goto(address)
        for button in ("Draw splats", "Camera"):
            shown.get_by_role("button", name=button).click()
        shown.wait_for_timeout(SETTLES_MS)
        shown.screenshot(path=picture)


def scores(result: Path, recording: Path) -> dict[str, float]:
    """The figures of `spiked evaluate`."""
    table = result / "score.json"
    command = [str(SPIKED), "evaluate", str(result), "--recording", str(recording), "--json", str(table)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    found: dict[str, float] = json.loads(table.read_text())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", type=Path)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--page", type=Path, metavar="PICTURE.png")
    given = parser.parse_args()
    recording = next(given.stream.glob("*.dat"))
    print(f"| {recording.stem} | " + " | ".join(SHOWN) + " | s |\n|" + "---|" * (len(SHOWN) + 2), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in ("live", "file"):
            out, begin = Path(folder) / name, time.monotonic()
            if name == "live":
                out.mkdir()
                same, poses = live(recording, out, given.steps, given.rate, given.page)
            else:
                command = [str(SPIKED), "reconstruct", str(recording), "-o", str(out), "--steps", str(given.steps)]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            seconds, found = time.monotonic() - begin, scores(out, recording)
            print(f"| {name} | " + " | ".join(f"{found[key]:.3f}" for key in SHOWN) + f" | {seconds:.0f} |", flush=True)
    print(f"\nThe recording is {'bit-exact' if same else 'NOT bit-exact'}; {poses} frames were tracked live.")


if __name__ == "__main__":
    main()
