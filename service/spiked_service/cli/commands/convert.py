"""`spiked convert`: write the frames of a recording in another format."""

from pathlib import Path
from typing import Annotated

import typer

from spiked.recording.geometry import orientation_questions
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import output, report_warning
from spiked_service.cli.flag_groups import with_groups
from spiked_service.conversion.form import READ_ONLY, Form
from spiked_service.conversion.reading import read_content
from spiked_service.conversion.writing import write_content


def _form(text: str) -> Form:
    """`row-tagged` is read as `row_tagged`."""
    try:
        return Form(text.replace("-", "_"))
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is not one of {', '.join(Form)}") from error


def _written_form(text: str) -> Form:
    form = _form(text)
    if form in READ_ONLY:
        raise typer.BadParameter(f"{form} is read and not written: choose another form")
    return form


_FORMS = f"<{'|'.join(Form)}>"
_WRITTEN_FORMS = f"<{'|'.join(form for form in Form if form not in READ_ONLY)}>"


@with_groups
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A recording, or the raw bytes of a camera.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A new file.")],
    to: Annotated[
        Form, typer.Option(help="The form to write.", parser=_written_form, metavar=_WRITTEN_FORMS)
    ] = Form.COMPACT,
    source_form: Annotated[
        Form | None,
        typer.Option("--from", help="The form of IN. Default: detected.", parser=_form, metavar=_FORMS),
    ] = None,
    array: Annotated[str | None, typer.Option(help="Name of the array in an .npz or HDF5 file.")] = None,
    *,
    geometry: g.GeometryFlags,
) -> None:
    """Convert between recordings (compact, row_tagged) and raw camera bytes (usb 400x250, pcie 1000x1000).

    Arrays of 0 and 1 [frames, rows, columns] in .npy, .npz and HDF5 files are read, too, photon cubes (.npy of packed
    bits) among them, and frames whose rows do not end with a byte (`--from bits`). Rows of arrays come top-down unless
    stated otherwise. Columns at the right beyond a multiple of 8 are left out.

    The bits of every frame are kept. Raw usb and pcie bytes have no sidecar: give rate, orientation and colour again
    when reading such a file. Raw pcie bytes do not record lost frames.

    Examples:

    - `spiked convert endpoint82.bin rec.dat`

    - `spiked convert rec.dat rec.usb --to usb`

    - `spiked convert photoncube.npy rec.dat --rate 97700`

    - `spiked convert spikes.h5 rec.dat --array sequence/spikes`

    - `spiked convert vidar.dat rec.dat --from bits --width 346 --height 260`
    """
    outputs.try_file("OUT", out)
    given = geometry.stated()
    content = read_content(source, source_form, given, report_warning, array)
    for question in orientation_questions(content.assumed, content.sensor):
        report_warning(question)
    count, lost = write_content(content, out, to, report_warning)
    size = f"{content.sensor.width}x{content.sensor.height}"
    output.print(f"{out}: {count} frames of {size}, {lost} lost, {to}", markup=False)
