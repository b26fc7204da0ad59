"""What each decision is worth: reconstruct streams with one thing changed at a time, and print the table of docs.

    .venv/bin/python evaluation/ablation.py STREAMS_DIR [--steps N] [--only TEXT] [--json OUT]

STREAMS_DIR holds folders as `spiked simulate` writes them (NAME.dat, sidecar, groundtruth.tum, views.json, views/).
Maps are compared with the true poses given, so that a row is about the map alone; rows about the path run without.
PSNR is of the held-out views at their true poses, with one gain for all of them.
"""

import argparse
import json
import os
import runpy
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import Window
from spiked.evaluate import score_trajectory
from spiked.pose import Array
from spiked.recon import LossName, MapOptions, Options, Reconstructor
from spiked.recon.frontend import windowing as views
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recon.frontend.spike_intervals import SpikeIntervals
from spiked.recon.frontend.windowing import View
from spiked.recon.mapping import mapper as mapping
from spiked.recon.mapping import pose_alignment as refine
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.pyramid import Level, Target
from spiked.recon.mapping.render_requests import RenderPlanner, RenderRequest
from spiked.recon.mapping.schedule import Schedule
from spiked.recon.mapping.seeding import Seeding
from spiked.recon.odometry import global_adjuster
from spiked.recon.odometry import initialisation as bootstrap
from spiked.recon.odometry import spline_fitting as smooth
from spiked.recon.odometry.odometry import Odometry
from spiked.recording import open_recording
from spiked.render.splats import RenderedImage
from spiked.scene import Scene
from spiked.sensor import Image
from spiked.spline import Spline
from spiked.trajectory import Trajectory

GREY, COLOUR, KINKED = "living", "camp_color", "garden_fast"
CHUNK = 64


@dataclass(frozen=True)
class Row:
    """One change."""

    name: str
    stream: str = GREY
    mapping: dict[str, Any] = field(default_factory=dict)
    patches: Callable[[], Iterator[None]] | None = None
    path: bool = False
    """Whether it is about the path: poses are not given."""
    aligned: bool = False
    """And that after the map was made and the path aligned with it."""
    steps_share: float = 1.0


class Counted(View):
    """Rates by counting in the nominal window, with the variance that counts have."""

    counts: Image

    @cached_property
    def light(self) -> tuple[Image, Image]:
        length = np.float32(self.end - self.begin)
        return self.counts / length, np.full(self.counts.shape, np.sqrt(0.2) / length, np.float32)

    def preview_rate(self, out: Image) -> Image:
        return self.rate


def counted(window: Window, after_gap: bool, *more: Any, **named: Any) -> View:
    """A view by counting; all pixels look at the nominal window."""
    none = np.zeros_like(window.spikes)
    edges = SpikeIntervals.of(replace(window, spikes=none))
    sharp = more[1] if len(more) > 1 else named.get("sharp")
    view = Counted(window.begin, window.end, edges, float(window.count.mean()), None, after_gap, sharp)
    view.__dict__["counts"] = window.count.astype(np.float32)
    return view


class Demosaiced(Level):
    """Full size with colours interpolated before the fit."""

    sites: NDArray[np.uint8]
    """The sensor's colours, [H, W]; the level itself has all of them everywhere."""

    def target(self, view: View, windows: Image | None, seen: NDArray[np.bool_] | None) -> Target:
        deviation = np.repeat(view.deviation[..., None], 3, -1)
        if seen is not None:
            deviation[~seen] = np.inf
        return Target(fill_mosaic(view.rate, self.sites), deviation, windows)


def demosaic_first(sensor: Any, camera: Any, threads: int | None) -> list[Level]:
    level = Demosaiced(sensor, camera, 1, threads)
    assert level.channels is not None
    Demosaiced.sites, level.channels = level.channels, None
    return [level]


def filled(rate: Image, channels: object) -> Image:
    """What the mapper takes colours from."""
    return fill_mosaic(rate, Demosaiced.sites)


RENDER, DENSIFY = Level.render, Mapper.densify


def sampled(self: Level, scene: Scene, request: RenderRequest, background: float = 0.0) -> RenderedImage:
    """The render at the sensor's sites."""
    image = RENDER(self, scene, request, background)
    return replace(image, values=np.take_along_axis(image.values, Demosaiced.sites[..., None], 2)[..., 0])


def densify(self: Mapper, *arguments: Any) -> None:
    """Densification by the errors at the sensor's sites."""
    with patched((Demosaiced, "target", Level.target), (Demosaiced, "render", sampled)):
        DENSIFY(self, *arguments)


@contextmanager
def patched(*changes: tuple[object, str, object]) -> Iterator[None]:
    """Attributes replaced for the time of a run."""
    with ExitStack() as stack:
        for owner, name, value in changes:
            stack.enter_context(mock.patch.object(owner, name, value))
        yield


WINDOWED = (RenderPlanner, "warped", lambda self, view, path: None)
"""Fast motion is rendered by windows, too."""
DOUBTFUL = {"seeding": Seeding(sure=0.0)}
FULL_SIZE = {"schedule": Schedule(coarse_share=1e-9)}


def splines(spacing: int, degree: int) -> Callable[[], Iterator[None]]:
    """Only splines of this kind."""

    def fitted(
        times: Array, rotations: Array, centres: Array, hessians: Array, _: int, span: Any, clock: Any
    ) -> Spline:
        spline = Spline.fit(times, rotations, centres, spacing, degree, span, clock)
        return smooth.fit_weighted(spline, times, rotations, centres, hessians)[0]

    return lambda: patched((global_adjuster, "fit_coarsest_spline", fitted))


def rows() -> list[Row]:
    """The table."""
    table = [
        Row("as it is"),
        Row("counted windows instead of spike-aligned", patches=lambda: patched((views, "make_view", counted))),
        Row("camera taken as still during a view", mapping={"sub_frames": 0}),
    ]
    for parts in (1, 2, 4):
        table.append(Row(f"{parts} sub-frame(s), blur matched", mapping={"sub_frames": parts}))
    for parts in (2, 4):
        table.append(
            Row(
                f"{parts} sub-frames, not blur matched",
                mapping={"sub_frames": parts, "blur_matched": False},
            )
        )
    table += [
        Row("without nuisances", mapping={"nuisances": False}),
        Row("black background while fitting", mapping={"background": 0.0}),
        Row("first splats of doubtful depth as well", mapping=DOUBTFUL),
        Row("without structural similarity", mapping={"ssim": 0.0}),
        *[Row(f"loss: {name}", mapping={"loss": name}) for name in LossName if name is not LossName.CHARGE],
        Row("charge between the spikes of 24 frames (as it is)", COLOUR, steps_share=0.4),
        Row("full size from the start", COLOUR, mapping=FULL_SIZE, steps_share=0.4),
        Row("fine detail not raised", COLOUR, mapping={"detail": 0.0}, steps_share=0.4),
        Row("first splats of doubtful depth as well", COLOUR, mapping=DOUBTFUL, steps_share=0.4),
        Row("windows and sub-frames, mosaic loss", COLOUR, patches=lambda: patched(WINDOWED), steps_share=0.4),
        Row("windows and sub-frames, demosaic first, without nuisances", COLOUR, mapping={"nuisances": False},
            patches=lambda: patched(WINDOWED, (mapping, "levels", demosaic_first),
                                    (mapping, "fill_mosaic", filled), (Mapper, "densify", densify)), steps_share=0.4),
        Row("path: as it is", path=True),
        Row("path: counted windows", path=True, patches=lambda: patched((views, "make_view", counted))),
    ]  # fmt: skip
    for spacing, degree in ((8, 3), (32, 3), (128, 3), (8, 1), (16, 1)):
        name = f"path: spline of degree {degree}, {spacing} frames a knot"
        table.append(Row(name, path=True, patches=splines(spacing, degree)))
    held, forgotten = (refine, "LANDMARK_DAMPING", 1e9), (Odometry, "information", lambda _: None)
    for stream in (GREY, KINKED):
        for name, patches in (
            ("as it is", None),
            ("without the tracks' prior", lambda: patched(forgotten)),
            ("landmarks of the map fixed as well", lambda: patched(held, forgotten)),
        ):
            table.append(Row(f"path with the map: {name}", stream, path=True, aligned=True, patches=patches))
    return table


def held_out(made: Reconstructor, folder: Path) -> float:
    """Mean PSNR of the views at their true poses, with one gain."""
    pairs = []
    for view in json.loads((folder / "views.json").read_text())["views"]:
        truth = cv2.imread(str(folder / view["file"]), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255
        pose = np.array(view["c2w"])
        image = made.view(pose[:3, :3], pose[:3, 3])
        pairs.append((image, truth[..., None] if truth.ndim == 2 else truth[..., ::-1]))
    gain = sum(float((a * b).sum()) for a, b in pairs) / sum(float((a * a).sum()) for a, _ in pairs)
    return float(np.mean([-10 * np.log10(np.mean((np.clip(gain * a, 0, 1) - b) ** 2)) for a, b in pairs]))


def run(row: Row, streams: Path, steps: int) -> dict[str, Any]:
    """Figures of one row."""
    folder = streams / row.stream
    recording = open_recording(folder / f"{row.stream}.dat")
    truth = Trajectory.read_tum(folder / "groundtruth.tum")
    options = Options(
        steps=0 if row.path and not row.aligned else round(steps * row.steps_share),
        poses=None if row.path else truth,
        mapping=replace(MapOptions(), **row.mapping),
    )
    begin = time.process_time()
    with row.patches() if row.patches else ExitStack():
        made = Reconstructor(recording.sensor, options, recording=recording)
        for first in range(0, recording.frames, CHUNK):
            made.feed(first, recording.read(first, min(CHUNK, recording.frames - first)))
        made.finish()
    figures: dict[str, Any] = {"row": row.name, "stream": row.stream, "cpu_s": time.process_time() - begin}
    if row.path:
        score = score_trajectory(truth=truth, estimate=made.trajectory(), frame_rate_hz=recording.sensor.frame_rate_hz)
        errors = score.errors
        figures |= {"coverage": score.coverage}
        figures |= {} if errors is None else {"ate_percent": errors.ate_percent, "rpe_r_deg": errors.rpe_r_deg}
    else:
        figures |= {"psnr_db": held_out(made, folder), "steps": options.steps}
    return figures


def grid(seeds: int) -> tuple[int, int]:
    """Of 3 * seeds random shaky scenes: how many the bootstrap accepts, and how many of these the wrong way round."""
    tests = runpy.run_path(str(Path(__file__).parents[1] / "tests" / "recon" / "test_initialisation.py"))
    accepted = reversed_ = 0
    for kind in ("planar", "two_plane", "general"):
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            tracks, depth = tests["observe"](tests["scene"](kind, rng), rng)
            winner = bootstrap.bootstrap(tracks, seed).winner
            if winner is not None:
                accepted += 1
                found = winner.bundle.points[:, 2]
                reversed_ += bool(np.corrcoef(1 / found, 1 / depth)[0, 1] < 0)
    return accepted, reversed_


def line(figures: dict[str, Any]) -> str:
    """A row of the table in Markdown."""
    quality = (
        f"{figures['psnr_db']:.2f} dB" if "psnr_db" in figures else f"ATE {figures.get('ate_percent', np.nan):.3f} %"
    )
    turn = f"{figures['rpe_r_deg']:.4f}" if "rpe_r_deg" in figures else ""
    return f"| {figures['stream']} | {figures['row']} | {quality} | {turn} | {figures['cpu_s']:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("streams", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=50, help="of each kind of scene for the bootstrap")
    parser.add_argument("--only", default="", help="rows whose name has this")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print("| stream | changed | held-out views, or path | RPE_r deg | CPU s |\n|---|---|---|---|---|", flush=True)
    made = []
    for row in rows():
        if options.only in row.name:
            made.append(run(row, options.streams, options.steps))
            print(line(made[-1]), flush=True)
    if not options.only:
        for name, change in (("with", None), ("without", lambda tracks, bundle: bundle)):
            with ExitStack() if change is None else patched((bootstrap, "_mirrored", change)):
                accepted, wrong = grid(options.seeds)
            found = f"{accepted} of {3 * options.seeds} accepted, {wrong} of them depth-reversed"
            print(f"| random scenes | bootstrap {name} mirror test | {found} | | |", flush=True)
    if options.json:
        options.json.write_text(json.dumps(made, indent=1))
    print(f"\n{options.steps} steps, seed 0, {len(os.sched_getaffinity(0))} cores")


if __name__ == "__main__":
    main()
