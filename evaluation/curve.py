"""How good the scene is after how many seconds: reconstruct a stream with known truth and draw held-out PSNR.

    .venv/bin/python evaluation/curve.py STREAM_DIR [STREAM_DIR ...] --out CURVE.png [--live]

Seconds are of work from the first frame on, without those spent on scoring; with --live the map also grows while
frames come, as in the daemon, half of the time. Poses of views are transformed by a similarity and refined, as in
`spiked evaluate`.
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from spiked.evaluate import score_views, similarity_of_trajectories
from spiked.recon import Options, Reconstructor, Status
from spiked.recording import open_recording
from spiked.trajectory import Trajectory

FRAMES = 64
LIVE_SHARE = 1.0
"""Seconds of mapping for each second of tracking."""


class Curve:
    """Held-out PSNR over seconds of work."""

    def __init__(self, folder: Path, interval_s: float) -> None:
        self.points: list[tuple[float, float]] = []
        self._truth = Trajectory.read_tum(folder / "groundtruth.tum")
        self._held_out = json.loads((folder / "views.json").read_text())
        files = [str(folder / view["file"]) for view in self._held_out["views"]]
        self._pictures = [np.float32(cv2.imread(file, cv2.IMREAD_UNCHANGED)) / np.float32(255) for file in files]
        self._interval_s = interval_s
        self._begun_s, self._scoring_s, self._next_s = time.perf_counter(), 0.0, 0.0

    def score(self, made: Reconstructor, at_once: bool = False) -> None:
        """Score the scene as it is now, if it is time to."""
        now_s = time.perf_counter() - self._begun_s - self._scoring_s
        if len(made.scene()) == 0 or (now_s < self._next_s and not at_once):
            return
        self._next_s = now_s + self._interval_s
        similarity = similarity_of_trajectories(
            truth=self._truth, estimate=made.trajectory(), frame_rate_hz=made.sensor.frame_rate_hz
        )
        poses = [np.array(view["c2w"]) for view in self._held_out["views"]]
        transformed = [similarity.poses(pose[:3, :3], pose[:3, 3]) for pose in poses]

        def render(rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
            image = made.view(rotation, centre)
            return image[..., 0] if image.shape[2] == 1 else image[..., ::-1]

        score = score_views(
            render, poses=transformed, truths=self._pictures, length=similarity.scale * self._held_out["median_depth"]
        )
        self.points.append((now_s, score.mean_psnr_db))
        print(f"{now_s:8.1f} s {score.mean_psnr_db:6.2f} dB {len(made.scene())} splats", flush=True)
        self._scoring_s = time.perf_counter() - self._begun_s - now_s


def reconstruct(folder: Path, live: bool, interval_s: float) -> list[tuple[float, float]]:
    """The curve of one stream."""
    recording = open_recording(folder / f"{folder.name}.dat")
    made = Reconstructor(recording.sensor, Options(), recording=recording)
    curve = Curve(folder, interval_s)

    def progress(status: Status) -> None:
        curve.score(made)

    for first in range(0, recording.frames, FRAMES):
        begin_s = time.perf_counter()
        made.feed(first, recording.read(first, min(FRAMES, recording.frames - first)))
        if live:
            made.improve(LIVE_SHARE * (time.perf_counter() - begin_s))
            curve.score(made)
    made.finish(progress)
    curve.score(made, at_once=True)
    return curve.points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("streams", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--live", action="store_true")
    parser.add_argument("--interval", type=float, default=2.0, help="seconds between scores")
    options = parser.parse_args()
    curves = {}
    for folder in options.streams:
        print(folder.name)
        curves[folder.name] = reconstruct(folder, options.live, options.interval)
    draw(curves, options.out)


def draw(curves: dict[str, list[tuple[float, float]]], out: Path) -> None:
    """One line for each stream, over the logarithm of the seconds."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name, points in curves.items():
        axes.plot(*zip(*points, strict=True), marker=".", label=name)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="seconds from the first frame", ylabel="PSNR of held-out views, dB")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
