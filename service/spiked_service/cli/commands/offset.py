"""`spiked offset`: the frames of two cameras in one time."""

import json
from pathlib import Path
from typing import Annotated

import typer

from spiked.recording import open_recording
from spiked.recording.time_base import offset as measured_offset
from spiked_service.cli.console import output


def offset(
    first: Annotated[Path, typer.Argument(help="A recording.")],
    second: Annotated[Path, typer.Argument(help="A recording that the same machine made at the same time.")],
    frame: Annotated[int, typer.Option(help="Also say where this frame of the first lies in the second.", min=0)] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print when the frames of one recording came in the count of another, by the clock of the machine.

    Example: `spiked offset left.dat right.dat --frame 20000`
    """
    a, b = open_recording(first), open_recording(second)
    found = measured_offset(a, b)
    there = float(found.frames_of_second(frame))
    sigma_frames = None if found.sigma_s is None else found.sigma_s * b.sensor.frame_rate_hz
    if as_json:
        figures = {
            "offset_s": found.seconds,
            "offset_sigma_s": found.sigma_s,
            "frame": frame,
            "frame_of_second": there,
            "frame_sigma": sigma_frames,
        }
        print(json.dumps(figures, indent=2))
        return
    later = "after" if found.seconds >= 0 else "before"
    output.print(
        f"{second.name} begins {1e3 * abs(found.seconds):.3f} ms {later} {first.name} "
        f"{_error(found.sigma_s, 1e3, 'ms')}",
        markup=False,
    )
    output.print(
        f"frame {frame} of {first.name} came with frame {there:.2f} of {second.name} "
        f"{_error(sigma_frames, 1.0, 'frames')}",
        markup=False,
    )


def _error(sigma: float | None, factor: float, unit: str) -> str:
    if sigma is None:
        return "(too few clock pairs for a standard deviation: record for ten seconds)"
    return f"(standard deviation {factor * sigma:.3f} {unit})"
