"""`spiked calibrate`: a camera's per-pixel gain, dark rate and defects, or its lens, from recordings."""

import json
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import typer
from rich.progress import Progress

from spiked.board import Board
from spiked.calibration import Calibration
from spiked.camera import Pinhole
from spiked.distortion import LensModel
from spiked.errors import ConfigurationError
from spiked.lens_calibration import board_views, calibrate_lens
from spiked.profile import CameraProfile
from spiked.recording import Recording, RecordingGeometry
from spiked.recording.geometry import Assumable
from spiked.sensor import Sensor
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import messages, output, report_warning
from spiked_service.cli.guided_calibration import take_recordings

_LENS = "Lens"


def calibrate(
    out: Annotated[Path, typer.Option("--out", "-o", help="The .npz file to write; with --board, a .json file.")],
    flat: Annotated[
        Path | None,
        typer.Argument(
            help="A recording of even light, such as a white wall out of focus; with --board, of the board."
        ),
    ] = None,
    dark: Annotated[Path | None, typer.Option(help="A recording with the lens cap on.")] = None,
    device: Annotated[
        str | None,
        typer.Option(
            help="A camera, such as usb0, to record both from: you are told when to cover the lens.", metavar="SOURCE"
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(help="Length of each of these recordings.", min=0.001, max=60, show_default=True)
    ] = 1.0,
    board: Annotated[
        str | None,
        typer.Option(
            help="Measure the lens by a ChArUco board of so many squares.",
            metavar="COLUMNSxROWS",
            rich_help_panel=_LENS,
        ),
    ] = None,
    markers: Annotated[
        str, typer.Option(help="OpenCV's set of the board's markers.", rich_help_panel=_LENS)
    ] = Board.dictionary,
    model: Annotated[
        LensModel | None,
        typer.Option(help="Formula of the distortion. Default: the one that explains more.", rich_help_panel=_LENS),
    ] = None,
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
    """Measure each pixel's gain and dark rate, and find dead and hot pixels; or, with --board, measure the lens.

    `spiked reconstruct --calibration FILE` corrects rates by the result. One second of each recording is enough. Use
    light at which pixels fire every 3 to 10 frames. With only one of the two recordings, OUT is completed: what the
    other one said before stays.

    With --board the recording shows a ChArUco board, held in the hand for two seconds or more: filling most of the
    image, tilted to all sides, near and far. OUT gets focal length, centre and distortion with standard deviations, for
    `--intrinsics OUT` of other commands; beside it OUT.png shows the errors.

    Examples:

    - `spiked calibrate --device usb0 -o camera.npz --write-profile camera.json`

    - `spiked calibrate flat.dat --dark dark.dat -o camera.npz`

    - `spiked calibrate --dark dark.dat -o camera.npz`

    - `spiked calibrate board.dat --board 9x6 -o lens.json --write-profile camera.json`

    - `spiked reconstruct rec.dat -o out --profile camera.json`
    """
    outputs.try_file("--out", out)
    if write_profile is not None:
        outputs.try_file("--write-profile", write_profile)
    geometry = RecordingGeometry(width, height, rate, layout, bit_order, flipped, mosaic)
    if device is not None:
        if flat is not None or dark is not None or board is not None:
            raise ConfigurationError("--device records by itself: leave out recordings and --board")
        if geometry != RecordingGeometry() or profile is not None:
            raise ConfigurationError(f"state the camera's options with the device: --device {device}?flipped=true&...")
        with tempfile.TemporaryDirectory(dir=out.absolute().parent, prefix=".spiked-") as folder:
            _calibrate_pixels(*take_recordings(device, seconds, Path(folder)), out, write_profile)
        return
    if board is not None:
        if flat is None:
            raise ConfigurationError("--board needs a recording of the board")
        shown = g.open_described(flat, geometry, profile).recording
        _calibrate_lens(shown, Board.parse(board, markers), model, out, write_profile)
        return
    recordings = [
        None if path is None else g.open_described(path, geometry, profile).recording for path in (flat, dark)
    ]
    _calibrate_pixels(recordings[0], recordings[1], out, write_profile)


def _calibrate_pixels(flat: Recording | None, dark: Recording | None, out: Path, profile: Path | None) -> None:
    """Write gains and dark rates; one that is not measured keeps its value of before."""
    known = next((one for one in (flat, dark) if one is not None), None)
    if known is None:
        raise ConfigurationError("give a recording of even light, --dark with one in the dark, or --device")
    for recording in (flat, dark):
        for warning in () if recording is None else recording.warnings:
            report_warning(warning)
    complete = flat is not None and dark is not None
    before = None if complete or not out.exists() or not out.stat().st_size else Calibration.read(out)
    calibration = Calibration.measure(flat, dark, before)
    calibration.write(out)
    if profile is not None:
        _write_profile(profile, out, known.sensor, known.assumed)
    output.print(f"{out}: {calibration.summary()}", markup=False)


def _write_profile(path: Path, calibration: Path | None, sensor: Sensor, assumed: tuple[Assumable, ...]) -> None:
    """What the recording says of its camera, and the calibration if there is one, over the profile that is there.

    What was `assumed` of the camera is not said: a profile makes it a fact, about which nobody is asked again.
    """
    before = CameraProfile.read(path) if path.exists() and path.stat().st_size else CameraProfile()
    stated = {
        "width": sensor.width,
        "height": sensor.height,
        "rate": None if "frame_rate" in assumed else sensor.frame_rate_hz,
        "mosaic": sensor.mosaic,
        "flipped": None if "flipped" in assumed else sensor.flipped,
        "intrinsics": None if before.fov is not None else Pinhole.of(sensor.intrinsics),
        "calibration": None if calibration is None else Path(os.path.relpath(calibration, path.parent)),
    }
    known = {name: value for name, value in stated.items() if value is not None}
    before.model_copy(update=known).write(path)
    output.print(f"{path}: camera profile with this calibration", markup=False)


def _calibrate_lens(
    recording: Recording, board: Board, model: LensModel | None, out: Path, profile: Path | None
) -> None:
    """Write the lens of a recording of a board, and the picture of its errors."""
    if out.suffix != ".json":
        raise ConfigurationError(f"--out {out}: a lens is written as a .json file, with a picture beside it")
    outputs.try_file("--out", out.with_suffix(".png"))
    for warning in recording.warnings:
        report_warning(warning)
    sensor = recording.sensor
    with Progress(console=messages, transient=True) as bar:
        task = bar.add_task("finding the board", total=1.0)
        views = board_views(recording, board, progress=lambda share: bar.update(task, completed=share))
    found = calibrate_lens(views, board, sensor.width, sensor.height, model)
    for warning in found.warnings():
        report_warning(warning)
    about = {"board": {"columns": board.columns, "rows": board.rows, "markers": board.dictionary}}
    with outputs.writing("--out", out):
        size = {"width": sensor.width, "height": sensor.height}
        out.write_text(json.dumps({**size, **found.report(), **about}, indent=1) + "\n", encoding="utf-8")
        picture = cv2.imencode(".png", found.picture(sensor.width, sensor.height))[1]
        out.with_suffix(".png").write_bytes(picture.tobytes())
    if profile is not None:
        before = CameraProfile.read(profile) if profile.exists() and profile.stat().st_size else CameraProfile()
        before.model_copy(update={"fov": None}).write(profile)
        _write_profile(profile, None, replace(sensor, intrinsics=found.intrinsics), recording.assumed)
    k, sigma = found.intrinsics, found.sigmas
    values = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, **(k.distortion.named() if k.distortion else {})}
    lens = ", ".join(f"{name} {value:.5g} (+- {sigma[name]:.2g})" for name, value in values.items() if name in sigma)
    output.print(
        f"{out}: {k.distortion.model if k.distortion else 'no distortion'}, {lens}; {len(found.pixels)} corners in "
        f"{found.views} images, {found.rms_px:.3f} px RMS, {found.rejected} left out",
        markup=False,
    )
