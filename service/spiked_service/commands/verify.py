"""`spiked verify`: whether a recording is whole and plausible."""

from pathlib import Path
from typing import Annotated

import typer

from spiked.recording import Verdict
from spiked.recording import verify as verify_recording
from spiked_service import geometry as g
from spiked_service.console import output


def verify(
    files: Annotated[list[Path], typer.Argument(help="Recordings.")],
    width: g.Width = None,
    height: g.Height = None,
    rate: g.Rate = None,
    layout: g.FrameLayout = None,
    bit_order: g.Bits = None,
    flipped: g.Flipped = None,
    mosaic: g.Colours = None,
) -> None:
    """Check recordings byte by byte: sizes, row numbers, sidecar, dead and stuck rows; exit code 1 if one is bad.

    Example: `spiked verify *.dat`
    """
    bad = False
    for file in files:
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
        bad = bad or found.verdict is Verdict.BAD
        figures = f"{found.recording.frames} frames, {found.spikes} spikes, {found.spike_rate:.4f} a pixel and frame"
        output.print(f"{file}: {found.verdict}, {figures}", markup=False)
        for reason in found.reasons:
            output.print(f"  {reason}", markup=False)
    if bad:
        raise typer.Exit(1)
