"""`spiked calibrate`: a camera's per-pixel gain, dark rate and defects from two recordings."""

import os
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from spiked.calibration import Calibration
from spiked.camera import Pinhole
from spiked.profile import CameraProfile
from spiked.recording import RecordingGeometry
from spiked.sensor import Sensor
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
    profile: g.Profile = None,
    write_profile: Annotated[
        Path | None,
        typer.Option("--write-profile", help="Camera profile to make, or to complete, with this calibration."),
    ] = None,
) -> None:
    """Measure each pixel's gain and dark rate, and find dead and hot pixels.

    `spiked reconstruct --calibration FILE` corrects rates by the result. One second of each recording is enough. Use
    light at which pixels fire every 3 to 10 frames.

    Examples:

    - `spiked calibrate flat.dat --dark dark.dat -o camera.npz`

    - `spiked calibrate flat.dat --dark dark.dat -o camera.npz --write-profile camera.json`

    - `spiked reconstruct rec.dat -o out --profile camera.json`
    """
    outputs.try_file("--out", out)
    if write_profile is not None:
        outputs.try_file("--write-profile", write_profile)
    geometry = RecordingGeometry(width, height, rate, layout, bit_order, flipped, mosaic)
    recordings = [
        None if path is None else g.open_described(path, geometry, profile).recording for path in (flat, dark)
    ]
    assert recordings[0] is not None
    for recording in recordings:
        for warning in () if recording is None else recording.warnings:
            report_warning(warning)
    calibration = Calibration.measure(recordings[0], recordings[1])
    calibration.write(out)
    if write_profile is not None:
        _write_profile(write_profile, out, recordings[0].sensor)
    good = ~calibration.dead
    spread = 100 * float(np.std(np.log(calibration.gain[good])))
    darkness = float(np.median(calibration.dark))
    output.print(
        f"{out}: gains differ by {spread:.1f} % (standard deviation), dark rate {darkness:.4f} spikes a frame, "
        f"{int(calibration.dead.sum())} of {calibration.dead.size} pixels dead or hot",
        markup=False,
    )


def _write_profile(path: Path, calibration: Path, sensor: Sensor) -> None:
    """What the recording says of its camera, and the calibration, over the profile that is there."""
    before = CameraProfile.read(path) if path.exists() and path.stat().st_size else CameraProfile()
    stated = {
        "width": sensor.width,
        "height": sensor.height,
        "rate": sensor.frame_rate_hz,
        "mosaic": sensor.mosaic,
        "flipped": sensor.flipped,
        "intrinsics": None if before.fov is not None else Pinhole.of(sensor.intrinsics),
        "calibration": Path(os.path.relpath(calibration, path.parent)),
    }
    known = {name: value for name, value in stated.items() if value is not None}
    before.model_copy(update=known).write(path)
    output.print(f"{path}: camera profile with this calibration", markup=False)
