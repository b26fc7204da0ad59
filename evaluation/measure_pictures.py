"""Measures what spikes from pictures cost: a path through a scene as videos, each turned into spikes and reconstructed.

    python evaluation/measure_pictures.py OUT_DIR [--scene PLY --poses TUM] [--seconds 0.5] [--steps 300]

Renders the path at each rate of pictures as a lossless video of 8 bits (sRGB) with its poses, makes a recording of it
with `spiked simulate --video`, with and without motion compensation, and one of the exact light. All are reconstructed
without poses and scored by `spiked evaluate` against the truth and the held-out views of the exact light. Prints a
table in Markdown; the rate error is that of windows of 64 frames in percent of white, sensor noise included, "own ATE"
is against the poses of the pictures, evenly joined, and s the time to make the recording. Without a
scene the built-in room is rendered.
"""

import argparse
import json
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

from spiked.render.cpu import usable_cores
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.record import camera_of_files
from spiked.trajectory import Trajectory

WIDTH, HEIGHT, FOV_DEG, RATE_HZ = 400, 250, 60.0, 20_000.0
"""Pixels, degrees and Hz of the spike camera."""
ROOM_FLOW_PX = 0.012
"""Image motion in the built-in room, pixels a frame: that of a hand."""
GAIN = 0.35
"""Spikes a frame of white."""
EXACT_STEP_PX = 0.1
"""Image motion between the exact pictures of the reference, pixels."""
VIEWS = 12
"""Held-out views."""


def encoded(light: np.ndarray) -> np.ndarray:
    """sRGB of 8 bits of linear light, as a video has it (blue, green, red)."""
    light = np.clip(light, 0, 1)
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    grey = np.round(255 * values).astype(np.uint8)
    return np.repeat(grey[..., None], 3, 2) if grey.ndim == 2 else grey[..., ::-1]


def make_video(camera: SimulatedCamera, path: Path, rate: float, frames: int) -> None:
    """The camera's pictures at a rate as PATH.avi, their poses as PATH.tum."""
    moments = np.arange(0, frames + 1e-6, RATE_HZ / rate)
    rotations, centres = camera.motion.poses(moments)
    Trajectory(moments / RATE_HZ, rotations, centres).write_tum(path.with_suffix(".tum"))
    writer = cv2.VideoWriter(str(path.with_suffix(".avi")), cv2.VideoWriter_fourcc(*"FFV1"), rate, (WIDTH, HEIGHT))
    for rotation, centre in zip(rotations, centres, strict=True):
        writer.write(encoded(camera.view(rotation, centre) / camera.gain))
    writer.release()


def spiked(*words: object) -> str:
    """Run a command; what it says on standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "spiked_service", *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"spiked {' '.join(map(str, words))}: {done.stderr}")
    return done.stderr


def rates(recording: Path, frames: int) -> np.ndarray:
    """Firing rates of windows of 64 frames [n, pixels]."""
    bits = np.unpackbits(np.fromfile(recording, np.uint8).reshape(-1, WIDTH // 8 * HEIGHT)[:frames], axis=1)
    return bits[: frames // 64 * 64].reshape(-1, 64, bits.shape[1]).mean(1)


def score(recording: Path, truth: Path, out: Path, steps: int) -> dict[str, float]:
    """Figures of a reconstruction from a recording, against the folder of the exact one."""
    begin = time.monotonic()
    spiked("reconstruct", recording, "-o", out, "--steps", steps)
    seconds = time.monotonic() - begin
    spiked("evaluate", out, "--recording", truth, "--json", out / "figures.json")
    figures = json.loads((out / "figures.json").read_text()) | {"seconds": seconds}
    # Against the poses of the pictures, evenly joined: the path that the light between the pictures has.
    spiked("evaluate", out, "--recording", recording, "--json", out / "own.json")
    return figures | {"own_ate": json.loads((out / "own.json").read_text()).get("ate_percent", np.nan)}


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--poses", type=Path)
    parser.add_argument("--rates", type=float, nargs="+", default=[24, 960])
    parser.add_argument("--seconds", type=float, default=0.5)
    parser.add_argument("--steps", type=int, default=300)
    given = parser.parse_args()
    given.out.mkdir(parents=True)
    # A whole number of pictures at every rate, so that all recordings have the same length.
    frames = int(given.seconds * min(given.rates)) * round(RATE_HZ / min(given.rates))
    frames -= frames % 64
    sensor = Sensor(WIDTH, HEIGHT, RATE_HZ, intrinsics=Intrinsics.from_fov(WIDTH, HEIGHT, FOV_DEG))
    shared = ["--frames", frames, "--fov", FOV_DEG]
    if given.scene is None:
        camera = SimulatedCamera(sensor, flow_px=ROOM_FLOW_PX, threads=usable_cores())
        scene = ["--flow", ROOM_FLOW_PX]
    else:
        camera = camera_of_files(sensor, given.scene, given.poses, gain=GAIN, threads=usable_cores())
        scene = ["--scene", given.scene, "--poses", given.poses]
    exact = given.out / "exact"
    begin = time.monotonic()
    spiked("simulate", "-o", exact, *shared, *scene, "--gain", GAIN, "--views", VIEWS, "--picture-step", EXACT_STEP_PX)
    truth = exact / "simulated.dat"
    rows = [("exact light", truth, None, time.monotonic() - begin)]
    for rate in given.rates:
        video = given.out / f"{rate:g}"
        make_video(camera, video, rate, frames + int(np.ceil(RATE_HZ / rate)))
        for kind in ("linear", "motion"):
            folder, begin = given.out / f"{rate:g}-{kind}", time.monotonic()
            spiked("simulate", "-o", folder, *shared, "--video", video.with_suffix(".avi"), "--poses",
                   video.with_suffix(".tum"), "--interpolation", kind)  # fmt: skip
            told = json.loads((folder / "simulated.json").read_text())["simulation"]["pictures"]["spacing"]
            rows.append((f"{rate:g} pictures/s, {kind}", folder / "simulated.dat", told, time.monotonic() - begin))
    print("| light | px apart, median / 95 % | rate error % | ATE % | own ATE % | RPE_r deg | PSNR dB | SSIM | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    reference = rates(truth, frames)
    for name, recording, told, seconds in rows:
        apart = "-" if told is None else f"{told['median_px']:.2f} / {told['p95_px']:.2f}"
        error = 100 / GAIN * float(np.sqrt(np.square(rates(recording, frames) - reference).mean()))
        out = given.out / f"out-{name.replace(' ', '-').replace('/', '')}"
        f = defaultdict(lambda: np.nan, score(recording, truth, out, given.steps))
        print(
            f"| {name} | {apart} | {error:.2f} | {f['ate_percent']:.3f} | {f['own_ate']:.3f} | {f['rpe_r_deg']:.4f} "
            f"| {f['psnr_db']:.2f} | {f['ssim']:.4f} | {seconds:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
