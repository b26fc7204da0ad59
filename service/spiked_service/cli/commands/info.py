"""`spiked info`: properties of a recording."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from spiked.recon.frontend.mosaic_check import recorded_layout_warnings
from spiked.recording import Recording
from spiked.recording.time_base import MeasuredRate, measured_rate
from spiked.sensor import Response
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import output, report_warning
from spiked_service.cli.flag_groups import with_groups

_SAMPLED_FRAMES = 4096
"""Frames from which the mean rate is computed."""


@with_groups
def info(
    file: Annotated[Path, typer.Argument(help="A recording.", readable=False)],
    *,
    geometry: g.GeometryFlags,
    profile: g.Profile = None,
) -> None:
    """Print geometry, length, spike rate and gaps of a recording, and the origin of the geometry.

    Examples:

    - `spiked info rec.dat`

    - `spiked info rec.dat --width 640 --height 360 --rate 40000 --mosaic BGGR`
    """
    stated = geometry.stated()
    recording = g.open_described(file, stated, profile).recording
    for warning in recording.warnings:
        report_warning(warning)
    for warning in recorded_layout_warnings(recording):
        report_warning(warning)
    for question in recording.questions:
        output.print(question, markup=False)
    for name, value in rows(recording):
        output.print(f"{name:10s} {value}", markup=False)


def rows(recording: Recording) -> list[tuple[str, str]]:
    """Names and values to print."""
    sensor = recording.sensor
    seconds = sensor.seconds(recording.frames)
    sampled = min(recording.frames, _SAMPLED_FRAMES)
    rate = _spike_rate(recording, sampled)
    part = "" if sampled == recording.frames else f" (first {sampled} frames)"
    k = sensor.intrinsics
    measured = measured_rate(recording.clock)
    order = "bottom-up" if sensor.flipped else "top-down"
    gaps = f"{len(recording.gaps)}, {sum(gap.count for gap in recording.gaps)} frames" if recording.gaps else "none"
    return [
        ("file", str(recording.path)),
        ("geometry", f"{sensor.width}x{sensor.height}, {recording.origin.sentence}"),
        ("layout", f"{sensor.layout}, rows {order}, {sensor.bit_order} first, {sensor.frame_bytes} bytes a frame"),
        *([] if sensor.response is Response.INTEGRATE_AND_FIRE else [("response", str(sensor.response))]),
        ("colour", str(sensor.mosaic) if sensor.mosaic else "grey"),
        ("frames", f"{recording.frames} at {sensor.frame_rate_hz:g} Hz, {seconds:.4f} s"),
        *([] if measured is None else [("clock", _clock(measured, sensor.frame_rate_hz))]),
        ("spikes", f"{rate:.4f} a pixel and frame, {rate * sensor.frame_rate_hz:.0f} a pixel and second{part}"),
        ("optics", f"fx {k.fx:.2f} fy {k.fy:.2f} cx {k.cx:.2f} cy {k.cy:.2f} px" if k else "not known"),
        ("lens", "not known" if k is None else str(k.distortion or "no distortion")),
        ("gaps", gaps),
    ]


def _clock(measured: MeasuredRate, stated_hz: float) -> str:
    off = 1e6 * (measured.hz / stated_hz - 1)
    drift = "" if measured.drift_ppm_s is None else f", drifting by {measured.drift_ppm_s:+.2f} ppm a second"
    return (
        f"{measured.hz:.3f} Hz by this machine's clock, standard deviation {measured.sigma_hz:.3f} Hz, "
        f"{off:+.1f} ppm from the stated rate{drift}"
    )


def _spike_rate(recording: Recording, frames: int) -> float:
    """Spikes a pixel and frame over the first frames."""
    sensor, spikes, chunk = recording.sensor, 0, 512
    for first in range(0, frames, chunk):
        count = min(chunk, frames - first)
        spikes += int(np.bitwise_count(recording.compact(first, count)).sum())
    return spikes / (frames * sensor.width * sensor.height)
