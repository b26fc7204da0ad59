"""`spiked noise-report`: how noisy a camera's counts are, and the charge between its spikes."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from spiked.noise import NoiseReport, measure_noise
from spiked_service import geometry as g
from spiked_service.console import output, report_warning


def noise_report(
    file: Annotated[Path, typer.Argument(help="A recording in which nothing moves.", readable=False)],
    frames: Annotated[int, typer.Option(min=80, max=60_000, help="Most frames that are looked at.")] = 2048,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here, too.")] = None,
    width: g.Width = None,
    height: g.Height = None,
    rate: g.Rate = None,
    layout: g.FrameLayout = None,
    bit_order: g.Bits = None,
    flipped: g.Flipped = None,
    mosaic: g.Colours = None,
) -> None:
    """Measure a camera's noise in a recording of a scene that stands still.

    Counting spikes in a window is good to about half a spike at each end; the charge between two spikes is good to the
    frame that they fell in. How much better it is depends on the camera: this says.

    Examples:

    - `spiked noise-report still.dat`

    - `spiked noise-report still.dat --width 400 --height 250 --rate 20000 --json noise.json`
    """
    recording = g.Geometry(width, height, rate, layout, bit_order, flipped, mosaic).open(file)
    for warning in recording.warnings:
        report_warning(warning)
    report = measure_noise(recording, frames)
    for line in text(report):
        output.print(line, markup=False)
    if json_file is not None:
        json_file.write_text(json.dumps(asdict(report), indent=2) + "\n")


def text(report: NoiseReport) -> list[str]:
    """The report as lines."""
    head = f"{'window':>8s} {'variance of counts':>19s} {'binomial':>9s} {'error by count':>15s} {'by charge':>10s}"
    return [
        f"{report.frames} frames, {report.rate:.4f} spikes a pixel and frame; "
        f"{report.interval:.2f} frames from spike to spike, give or take {report.jitter:.2f}",
        head,
        *(
            f"{row.frames:8d} {row.variance:19.3f} {row.binomial_variance:9.3f} {row.counted:15.2%} {row.charge:10.2%}"
            for row in report.windows
        ),
    ]
