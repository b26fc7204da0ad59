"""`spiked noise-report`: noise of spike counts and of the charge between spikes, or of photon counts."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from spiked.noise import NoiseReport, measure_noise
from spiked.photon_noise import PhotonNoiseReport, measure_photon_noise
from spiked.sensor import Response
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import output, report_warning
from spiked_service.cli.flag_groups import with_groups


@with_groups
def noise_report(
    file: Annotated[Path, typer.Argument(help="A recording in which nothing moves.", readable=False)],
    frames: Annotated[int, typer.Option(min=80, max=60_000, help="Maximum number of frames to read.")] = 2048,
    json_file: Annotated[Path | None, typer.Option("--json", help="Also write the figures to this file.")] = None,
    *,
    geometry: g.GeometryFlags,
    profile: g.Profile = None,
) -> None:
    """Measure the noise of a camera from a recording of a static scene.

    A count of spikes in a window is off by up to half a spike at each end. The charge between two spikes is known to
    one frame. The report compares the two for this camera.

    Of a single-photon camera (`--response bernoulli`, or its sidecar says so) the report has the flux, the variance of
    counts against that of independent photons, afterpulsing or dead time, and crosstalk between neighbours.

    Examples:

    - `spiked noise-report still.dat`

    - `spiked noise-report cube.dat --response bernoulli`

    - `spiked noise-report still.dat --width 400 --height 250 --rate 20000 --json noise.json`
    """
    if json_file is not None:
        outputs.try_file("--json", json_file)
    stated = geometry.stated()
    recording = g.open_described(file, stated, profile).recording
    for warning in recording.warnings:
        report_warning(warning)
    counted = recording.sensor.response is Response.BERNOULLI
    report = measure_photon_noise(recording, frames) if counted else measure_noise(recording, frames)
    for line in text(report) if isinstance(report, NoiseReport) else photon_text(report):
        output.print(line, markup=False)
    if json_file is not None:
        with outputs.writing("--json", json_file):
            json_file.write_text(json.dumps(asdict(report), indent=2) + "\n")


def text(report: NoiseReport) -> list[str]:
    """The report as lines."""
    head = f"{'window':>8s} {'variance of counts':>19s} {'binomial':>9s} {'error by count':>15s} {'by charge':>10s}"
    return [
        f"{report.frames} frames, {report.rate:.4f} spikes a pixel and frame; "
        f"{report.interval:.2f} +- {report.jitter:.2f} frames from spike to spike",
        head,
        *(
            f"{row.frames:8d} {row.variance:19.3f} {row.binomial_variance:9.3f} {row.counted:15.2%} {row.charge:10.2%}"
            for row in report.windows
        ),
    ]


def photon_text(report: PhotonNoiseReport) -> list[str]:
    """The report of a single-photon camera as lines."""
    after = "dead time" if report.afterpulsing < 0 else "afterpulsing"
    head = f"{'window':>8s} {'variance / photons':>19s} {'error of flux':>14s} {'by photons':>11s}"
    return [
        f"{report.frames} frames, a pixel fires in {report.rate:.2%} of them; flux {report.flux:.4f} photons a pixel "
        "and frame",
        f"{after} {abs(report.afterpulsing):.2%}, crosstalk {report.crosstalk:.2%}, {report.hot_pixels} hot pixels",
        head,
        *(
            f"{row.frames:8d} {row.variance:19.3f} {row.flux_error:14.2%} {row.photon_error:11.2%}"
            for row in report.windows
        ),
    ]
