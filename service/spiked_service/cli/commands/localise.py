"""`spiked localise`: where the camera of a recording was in a known map."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import track

from spiked.errors import ConfigurationError, RecordingError
from spiked.recon import Localisation, Localiser, MapIndex
from spiked.recon.environment import machine, versions
from spiked.recording import Recording
from spiked.sensor import Sensor
from spiked.whole_files import whole_folder
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import messages, output, report_warning
from spiked_service.cli.flag_groups import with_groups
from spiked_service.cli.maps import read_map
from spiked_service.results.localisation_figures import localisation_figures
from spiked_service.results.map_folder import MAP_FILES, camera_in
from spiked_service.results.map_reports import LOCALISATION, recording_section
from spiked_service.results.recording_feed import pieces

NOT_RECOGNISED = 1
"""Exit code; errors have 2."""


@with_groups
def localise(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="Output folder of `spiked reconstruct`.")],
    file: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording.", readable=False)],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for trajectory.tum and localisation.json.")
    ] = None,
    start: Annotated[int, typer.Option(help="First stored frame to use.", min=0)] = 0,
    frames: Annotated[int | None, typer.Option(help="Number of frames to use. Default: all.", min=1)] = None,
    json_out: Annotated[Path | None, typer.Option("--json", help="Also write the figures to this file.")] = None,
    *,
    optics: g.OpticsFlags,
    geometry: g.GeometryFlags,
    profile: g.Profile = None,
    calibration: g.CalibrationFile = None,
) -> None:
    """Find where the camera of a recording was in a map.

    Prints the first and the last pose, in the map's frame of reference and unit of length, and how sure they are. With
    `-o`, trajectory.tum has one pose for each window of frames, and localisation.json the figures for `spiked report`.
    1,000 frames at 20 kHz suffice.
    If the map is not recognised, the exit code is 1.

    Examples:

    - `spiked localise out again.dat`

    - `spiked localise out again.dat -o where --start 20000 --frames 1000`
    """
    if out is not None:
        _check_folder(out)
    if json_out is not None:
        outputs.try_file("--json", json_out)
    known = read_map(map_folder)
    described = g.open_described(file, geometry.stated(), profile)
    recording = described.recording
    for warning in recording.warnings:
        report_warning(warning)
    end = _end(recording, start, frames)
    sensor = optics.of(recording.sensor)
    index = MapIndex(known.scene, known.known.trajectory, camera_in(sensor, known.camera))
    localiser = Localiser(index, sensor, g.read_calibration(calibration, described))
    for first_frame, part in track(
        list(_parts(recording, start, end)), "localising", console=messages, transient=True,
        disable=not messages.is_terminal,
    ):  # fmt: skip
        localiser.feed(first_frame, recording.read(*part))
    found = localiser.finish()
    _show(found, sensor)
    if json_out is not None:
        with outputs.writing("--json", json_out):
            json_out.write_text(json.dumps(localisation_figures(found, sensor), indent=1), encoding="utf-8")
    if not found.recognised:
        raise typer.Exit(NOT_RECOGNISED)
    if out is not None:
        with outputs.writing("--out", out), whole_folder(out) as making:
            report = _report(found, index, recording, sensor)
            (making / LOCALISATION).write_text(json.dumps(report, indent=1), encoding="utf-8")
            found.trajectory(sensor.frame_rate_hz).write_tum(making / "trajectory.tum")
        output.print(f"{out / 'trajectory.tum'}: {len(found.views)} poses", markup=False)


def _check_folder(out: Path) -> None:
    """Raises ConfigurationError for a folder that cannot be written, or that holds a map."""
    if any((out / name).exists() for name in MAP_FILES if name != "trajectory.tum"):
        raise ConfigurationError(f"--out {out} holds a reconstruction, whose path would be lost; name another folder")
    outputs.try_folder("--out", out, ("trajectory.tum", LOCALISATION))


def _report(found: Localisation, index: MapIndex, recording: Recording, sensor: Sensor) -> dict[str, object]:
    """For `spiked report`: the figures, and what they were found with."""
    lens = index.camera.intrinsics
    return {
        "versions": versions(),
        "machine": machine(),
        "sensor": {"width": sensor.width, "height": sensor.height, "frame_rate_hz": sensor.frame_rate_hz},
        "focal_px": [lens.fx, lens.fy],
        "principal_point_px": [lens.cx, lens.cy],
        "recording": recording_section(recording),
        "localisation": localisation_figures(found, sensor),
    }


def _end(recording: Recording, start: int, frames: int | None) -> int:
    if start >= recording.frames:
        raise RecordingError(f"--start {start} is beyond the {recording.frames} frames of {recording.path}")
    end = recording.frames if frames is None else start + frames
    if end > recording.frames:
        raise RecordingError(f"--start {start} --frames {frames} is beyond the {recording.frames} frames there are")
    return end


def _parts(recording: Recording, start: int, end: int) -> Iterator[tuple[int, tuple[int, int]]]:
    """Absolute index of the first frame, and first and count of the stored frames, of pieces without gaps."""
    for piece in pieces(recording):
        first, last = max(piece.first, start), min(piece.first + piece.count, end)
        if first < last:
            yield piece.index + first - piece.first, (first, last - first)


def _show(found: Localisation, sensor: Sensor) -> None:
    output.print(f"{found.reason}", markup=False)
    if not found.views:
        return
    for name, view in (("first", found.views[0]), ("last", found.views[-1])):
        place = " ".join(f"{value:.4f}" for value in view.pose.centre)
        output.print(
            f"{name} pose, at {sensor.seconds(view.time):.4f} s: position {place} +- {view.fit.sigma:.4f}, "
            f"{view.fit.inliers} points agree ({view.fit.share:.0%}), correlation {view.correlation:.2f}",
            markup=False,
        )
