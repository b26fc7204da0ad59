"""`spiked cut`: a range of a recording."""

from pathlib import Path
from typing import Annotated

import typer

from spiked.errors import RecordingError
from spiked.recording import Recording, remove_recording
from spiked.recording.cut import cut_recording
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import output, report_warning
from spiked_service.cli.flag_groups import with_groups
from spiked_service.cli.ranges import Range, number_range
from spiked_service.conversion.truth import TRUTH, cut_truth


@with_groups
def cut(
    file: Annotated[Path, typer.Argument(help="A recording.", readable=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="A new file, .dat.")],
    frames: Annotated[
        Range | None, typer.Option(help="Frames from A to B, B exclusive.", parser=number_range(int), metavar="A:B")
    ] = None,
    seconds: Annotated[
        Range | None, typer.Option(help="The same in seconds.", parser=number_range(float), metavar="A:B")
    ] = None,
    *,
    geometry: g.GeometryFlags,
) -> None:
    """Write a range of a recording as a recording of its own.

    Each frame keeps its bits, and the file its layout. Sidecar, gaps, clock, and index with checksums are cut along,
    and so are groundtruth.tum and views.json with its pictures, if they lie beside the recording and OUT is in another
    folder; their times begin at the new first frame. Frames and seconds count from the first frame of the recording,
    lost frames included. A or B may be left out. Raw bytes of a camera and arrays become recordings by
    `spiked convert`.

    Examples:

    - `mkdir part && spiked cut rec.dat -o part/rec.dat --seconds 1.5:4`

    - `spiked cut rec.dat -o begin.dat --frames :2000`
    """
    if (frames is None) == (seconds is None):
        raise typer.BadParameter("give a range, by --frames A:B or by --seconds A:B", param_hint="--frames")
    outputs.try_file("--out", out)
    recording = g.open_described(file, geometry.stated(), None).recording
    for warning in recording.warnings:
        report_warning(warning)
    rate = recording.sensor.frame_rate_hz
    truth = _truth(file, out)
    begin, end = _frames(recording, frames or seconds or Range(None, None), 1.0 if frames else rate)
    count, lost = cut_recording(recording, out, begin, end)
    if truth:
        try:
            with outputs.writing("--out", out.parent):
                cut_truth(file.resolve().parent, out.resolve().parent, truth, begin / rate, end / rate)
        except BaseException:
            remove_recording(out)  # so that the same command can be repeated
            raise
    with_truth = f", {' and '.join(truth)}" if truth else ""
    output.print(f"{out}: frames {begin}:{end} of {file.name}: {count} frames, {lost} lost{with_truth}", markup=False)


def _frames(recording: Recording, wanted: Range, rate_hz: float) -> tuple[int, int]:
    """Numbers of frames of a range, which is in units of 1 / rate_hz."""
    begin, end = wanted.begin, wanted.end
    last = recording.capture_index(recording.frames - 1) + 1
    return 0 if begin is None else round(begin * rate_hz), last if end is None else round(end * rate_hz)


def _truth(file: Path, out: Path) -> list[str]:
    """Names of what is to be cut along. Raises RecordingError if it would be written over."""
    source, folder = file.resolve().parent, out.resolve().parent
    found = [name for name in TRUTH if (source / name).is_file()]
    if found and source == folder:
        report_warning(f"{' and '.join(found)} of the same folder are not cut along: write to another one")
        return []
    for name in found:
        if (folder / name).exists():
            raise RecordingError(f"{folder / name} exists already; write the part to a folder of its own")
    return found
