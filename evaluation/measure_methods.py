"""The paper's method beside ours, part by part: the tables of docs/paper.md.

    .venv/bin/python evaluation/measure_methods.py losses|poses|paths|depths STREAMS_DIR [--only NAME] [--steps N]

losses: maps fitted to given poses with each loss, for equal steps, and then for as many steps as take the processor
        seconds of the charge: other work on the machine does not change them.
poses:  a map fitted to the true poses of living is kept; a path disturbed by 0.2 degrees and 0.5 % is corrected by the
        pose gradient of the paper and by our alignment.
depths: the paper's method from a first view that is flat, or at the depth of --scene, a PLY with the unit and frame of
        the truth, with noise of a share of the depth. Without a PLY it is the depth of our map on the true path.
paths:  no poses are given: the paper's method as it is and with parts of ours, beside ours.

STREAMS_DIR holds folders as `spiked simulate` writes them (NAME.dat, sidecar, groundtruth.tum, views.json, views/). The
PSNR is of the held-out views at their true poses, with one gain.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spiked.evaluate import score_trajectory
from spiked.pose import log_so3
from spiked.recon import Initialisation, LossName, MethodName, Options, PoseStepName, Reconstructor
from spiked.recon.mapping.pose_steps import GaussNewton, PoseGradient, PoseStep
from spiked.recording import Recording, open_recording
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.spline import Spline
from spiked.trajectory import Trajectory

CHUNK = 64
STREAMS = "living", "garden", "garden_fast", "camp_color"
DISTURBED_DEG, DISTURBED_PERCENT = 0.2, 0.5
"""RMS rotation, and RMS distance in percent of the RMS radius of the path, of the disturbance."""
KNOT_FRAMES = 16.0
FIRST_VIEW_FRAME = 16
"""About the middle of the first view."""
POSE_CHUNK = 50


@dataclass(frozen=True)
class Stream:
    """A recording with its truth."""

    folder: Path
    frames: int | None

    @property
    def recording(self) -> Recording:
        """The recording."""
        return open_recording(self.folder / f"{self.folder.name}.dat")

    @property
    def truth(self) -> Trajectory:
        """The true poses."""
        return Trajectory.read_tum(self.folder / "groundtruth.tum")

    def reconstruct(self, options: Options) -> Reconstructor:
        """Feed all frames and refine."""
        return self.timed(options)[0]

    def timed(self, options: Options) -> tuple[Reconstructor, float]:
        """The same with the processor seconds of the refinement."""
        recording = self.recording
        made = Reconstructor(recording.sensor, options, recording=recording)
        count = min(recording.frames, self.frames or recording.frames)
        for first in range(0, count, CHUNK):
            made.feed(first, recording.read(first, min(CHUNK, count - first)))
        begin_s = time.process_time()
        made.finish()
        return made, time.process_time() - begin_s

    def psnr_db(self, made: Reconstructor) -> float:
        """Mean over the held-out views at their true poses, with one gain."""
        pairs = []
        for view in json.loads((self.folder / "views.json").read_text())["views"]:
            truth = cv2.imread(str(self.folder / view["file"]), cv2.IMREAD_UNCHANGED)
            assert truth is not None
            image = truth.astype(np.float32) / 255
            pose = np.array(view["c2w"])
            shown = made.view(pose[:3, :3], pose[:3, 3])
            pairs.append((shown, image[..., None] if image.ndim == 2 else image[..., ::-1]))
        gain = sum(float((a * b).sum()) for a, b in pairs) / sum(float((a * a).sum()) for a, _ in pairs)
        return float(np.mean([-10 * np.log10(np.mean((np.clip(gain * a, 0, 1) - b) ** 2)) for a, b in pairs]))


def losses(streams: list[Stream], steps: int) -> Iterator[dict[str, Any]]:
    """Each loss on given poses."""
    for stream in streams:
        charge_s: float | None = None
        for name in LossName:
            many = steps
            for kind in ("equal steps",) if name is LossName.CHARGE else ("equal steps", "equal seconds"):
                made, cpu_s = stream.timed(Options(steps=many, poses=stream.truth, loss=name))
                charge_s = charge_s or cpu_s
                yield {
                    "stream": stream.folder.name, "what": f"{name}, {kind}", "psnr_db": stream.psnr_db(made),
                    "steps": made.trainer.mapper.steps, "cpu_s": cpu_s,
                }  # fmt: skip
                many = round(steps * charge_s / cpu_s)


def errors(path: Spline, truth: Spline, times: np.ndarray) -> tuple[float, float]:
    """RMS rotation in degrees, and RMS distance in percent of the RMS radius; the map's frame is that of the truth."""
    (rotations, centres), (true, at) = path.poses(times), truth.poses(times)
    turned = log_so3(rotations @ true.swapaxes(1, 2))
    radius = np.sqrt(((at - at.mean(0)) ** 2).sum(1).mean())
    away = np.sqrt(((centres - at) ** 2).sum(1).mean())
    return float(np.degrees(np.sqrt((turned**2).sum(1).mean()))), float(100 * away / radius)


def disturbed(path: Spline, times: np.ndarray, seed: int) -> Spline:
    """The path with random knots, scaled to the disturbance."""
    rng = np.random.default_rng(seed)
    turn, way = rng.normal(size=(2, len(path.centres), 3))
    turn[1] = way[1] = 0  # the gradient keeps the knot of the first view
    turn *= np.radians(DISTURBED_DEG) / np.radians(errors(path.move(1e-3 * turn, 0 * way), path, times)[0]) * 1e-3
    way *= DISTURBED_PERCENT / errors(path.move(0 * turn, 1e-3 * way), path, times)[1] * 1e-3
    return path.move(turn, way)


def poses(stream: Stream, steps: int, pose_steps: int, window_frames: int | None) -> Iterator[dict[str, Any]]:
    """A disturbed path corrected by a map that is kept."""
    options = Options(steps=steps, poses=stream.truth, method=MethodName.NOPE_SGS, window_frames=window_frames)
    made = stream.reconstruct(options)
    assert made.path is not None
    frames = np.arange(np.ceil(made.path.begin), np.floor(made.path.end))
    rotations, centres = made.path.poses(frames)
    ids, spacing = made.views.mappable(made.path), max(KNOT_FRAMES, window_frames or 0)
    span = made.views[ids[0]].time - spacing, made.views[ids[-1]].time + spacing  # a knot for each view
    truth = Spline.fit(frames, rotations, centres, spacing, 1, span)
    start = disturbed(truth, frames, seed=0)
    yield {"what": "disturbed", **dict(zip(("deg", "percent"), errors(start, truth, frames), strict=True))}
    ways: list[tuple[str, PoseStep, int]] = [
        ("our alignment", GaussNewton(made.trainer), 5 * POSE_CHUNK),
        ("pose gradient, each render", PoseGradient(made.trainer, 0), pose_steps),
        ("pose gradient, difference of renders", PoseGradient(made.trainer, 0, difference=True), pose_steps),
    ]
    for name, way, count in ways:
        path, begin = start, time.perf_counter()
        for done in range(0, count, POSE_CHUNK):
            path = way.improve(path, ids, POSE_CHUNK, done / count)
        found = dict(zip(("deg", "percent"), errors(path, truth, frames), strict=True))
        number = 5 if isinstance(way, GaussNewton) else count
        yield {"what": name, **found, "steps": number, "seconds": time.perf_counter() - begin}


PATHS: dict[str, dict[str, Any]] = {
    "ours": {},
    "nope-sgs": {"method": MethodName.NOPE_SGS},
    "nope-sgs from tracks": {"method": MethodName.NOPE_SGS, "initialisation": Initialisation.TRACKS},
    "nope-sgs, charge": {"method": MethodName.NOPE_SGS, "loss": LossName.CHARGE},
    "nope-sgs, alignment": {"method": MethodName.NOPE_SGS, "pose_step": PoseStepName.ALIGNMENT},
    "ours, pose gradient": {"pose_step": PoseStepName.GRADIENT},
}


def paths(streams: list[Stream], steps: int, seeds: int, window_frames: int | None) -> Iterator[dict[str, Any]]:
    """Nothing is given."""
    for stream in streams:
        for name, options in PATHS.items():
            for seed in range(seeds):
                made = stream.reconstruct(Options(steps=steps, seed=seed, window_frames=window_frames, **options))
                path = made.trajectory()
                rate = stream.recording.sensor.frame_rate_hz
                score = score_trajectory(truth=stream.truth, estimate=path, frame_rate_hz=rate)
                row = {"stream": stream.folder.name, "what": name, "seed": seed, "coverage": score.coverage}
                if score.errors is not None:
                    row |= {"ate_percent": score.errors.ate_percent, "rpe_r_deg": score.errors.rpe_r_deg}
                yield row | {"loss": made.trainer.mapper.loss, "steps": made.trainer.mapper.steps, "s": made.work_s}


def depths(stream: Stream, ply: Path | None, steps: int, seeds: int) -> Iterator[dict[str, Any]]:
    """The path that grows with its map, from first views of several qualities."""
    sensor, truth = stream.recording.sensor, stream.truth
    assert sensor.intrinsics is not None
    rasteriser = rasteriser_for(Camera(sensor.intrinsics, sensor.width, sensor.height))
    at = truth.rotations[FIRST_VIEW_FRAME][None], truth.centres[FIRST_VIEW_FRAME][None]
    scene = Scene.read_ply(ply) if ply else replace(stream, frames=None).reconstruct(Options(poses=truth)).scene()
    depth = rasteriser.forward(scene, *at).depth.astype(np.float64)
    noise = np.random.default_rng(0).normal(size=depth.shape)
    chosen = {"flat": None, **{f"true, noise {share:.0%}": depth * np.exp(share * noise) for share in (0.0, 0.1, 0.3)}}
    for name, given in chosen.items():
        for seed in range(seeds):
            options = Options(steps=steps, seed=seed, method=MethodName.NOPE_SGS, first_depth=given)
            path = stream.reconstruct(options).trajectory()
            score = score_trajectory(truth=truth, estimate=path, frame_rate_hz=sensor.frame_rate_hz)
            assert score.errors is not None
            yield {"what": name, "seed": seed, "ate_percent": score.errors.ate_percent, "rpe": score.errors.rpe_r_deg}


def line(row: dict[str, Any]) -> str:
    """A row in Markdown."""
    return "| " + " | ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("losses", "poses", "paths", "depths"))
    parser.add_argument("streams", type=Path)
    parser.add_argument("--only", default="", help="the stream of this name; default: all four")
    parser.add_argument("--row", default="", help="paths: the row of this name alone")
    parser.add_argument("--steps", type=int, default=1000, help="steps of the map; of paths: of map and poses")
    parser.add_argument("--pose-steps", type=int, default=1500, help="of the table poses")
    parser.add_argument("--seeds", type=int, default=1, help="of the table paths")
    parser.add_argument("--window-frames", type=int, help="of a view, not of losses; default: by the motion")
    parser.add_argument("--frames", type=int, help="first frames of each recording; default: all")
    parser.add_argument("--scene", type=Path, help="of the table depths; default: our map")
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args()
    if options.row:
        for name in set(PATHS) - {options.row}:
            del PATHS[name]
    chosen = [Stream(options.streams / name, options.frames) for name in STREAMS if options.only in ("", name)]
    match options.table:
        case "losses":
            rows = losses(chosen, options.steps)
        case "poses":
            rows = poses(chosen[0], options.steps, options.pose_steps, options.window_frames)
        case "depths":
            rows = depths(chosen[0], options.scene, options.steps, options.seeds)
        case _:
            rows = paths(chosen, options.steps, options.seeds, options.window_frames)
    made = []
    for row in rows:
        made.append(row)
        print(line(row), flush=True)
    if options.json:
        options.json.write_text(json.dumps(made, indent=1))


if __name__ == "__main__":
    main()
