"""`spiked verify`: check that recordings are complete and plausible."""

from pathlib import Path
from typing import Annotated

import typer

from spiked.errors import RecordingError
from spiked.recording import Verdict
from spiked.recording import verify as verify_recording
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import output, report_error


def verify(
    files: Annotated[list[Path], typer.Argument(help="Recordings.", readable=False)],
    width: g.Width = None,
    height: g.Height = None,
    rate: g.Rate = None,
    layout: g.FrameLayout = None,
    bit_order: g.Bits = None,
    flipped: g.Flipped = None,
    mosaic: g.Colours = None,
) -> None:
    """Check recordings: sizes, checksums, row numbers, sidecar, dead and stuck rows.

    The exit code is 1 if a recording is bad or its sidecar contradicts the geometry given, and 2 if a file is no
    recording at all; the others are still checked.

    Example: `spiked verify *.dat`
    """
    worst = 0
    for file in files:
        try:
            found = verify_recording(
                file,
                width=width,
                height=height,
                frame_rate_hz=rate,
                layout=layout,
                bit_order=bit_order,
                flipped=flipped,
                mosaic=mosaic,
            )
        except RecordingError as error:
            report_error(error)
            worst = 2
            continue
        worst = max(worst, int(found.verdict is Verdict.BAD or bool(found.recording.overruled)))
        figures = f"{found.recording.frames} frames, {found.spikes} spikes, {found.spike_rate:.4f} a pixel and frame"
        output.print(f"{file}: {found.verdict}, {figures}", markup=False)
        for reason in found.reasons:
            output.print(f"  {reason}", markup=False)
    if worst:
        raise typer.Exit(worst)
