"""`spiked calibrate`: a camera's per-pixel gain, dark rate and defects from two recordings."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from spiked.calibration import Calibration
from spiked.recording import RecordingGeometry, open_recording
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import output, report_warning


def calibrate(
    flat: Annotated[Path, typer.Argument(help="A recording of even light, such as a white wall out of focus.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The .npz file to write.")],
    dark: Annotated[Path | None, typer.Option(help="A recording with the lens cap on.")] = None,
    width: g.Width = None,
    height: g.Height = None,
    rate: g.Rate = None,
    layout: g.FrameLayout = None,
    bit_order: g.Bits = None,
    flipped: g.Flipped = None,
    mosaic: g.Colours = None,
) -> None:
    """Measure each pixel's gain and dark rate, and find dead and hot pixels.

    `spiked reconstruct --calibration FILE` corrects rates by the result. One second of each recording is enough. Use
    light at which pixels fire every 3 to 10 frames.

    Examples:

    - `spiked calibrate flat.dat --dark dark.dat -o camera.npz`

    - `spiked reconstruct rec.dat -o out --calibration camera.npz`
    """
    outputs.try_file("--out", out)
    geometry = RecordingGeometry(width, height, rate, layout, bit_order, flipped, mosaic)
    recordings = [None if path is None else open_recording(path, **geometry.stated()) for path in (flat, dark)]
    assert recordings[0] is not None
    for recording in recordings:
        for warning in () if recording is None else recording.warnings:
            report_warning(warning)
    calibration = Calibration.measure(recordings[0], recordings[1])
    calibration.write(out)
    good = ~calibration.dead
    spread = 100 * float(np.std(np.log(calibration.gain[good])))
    darkness = float(np.median(calibration.dark))
    output.print(
        f"{out}: gains differ by {spread:.1f} % (standard deviation), dark rate {darkness:.4f} spikes a frame, "
        f"{int(calibration.dead.sum())} of {calibration.dead.size} pixels dead or hot",
        markup=False,
    )
