"""`spiked convert`: write the frames of a recording in another format."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
import typer
from numpy.typing import NDArray
from spiked_driver.framing import USB_HEIGHT, USB_WIDTH, Framing, UsbFraming, encode_usb
from spiked_driver.pcie import PCIE_SIZE, PcieFraming, encode_pcie
from spiked_driver.source import Chunk

from spiked.errors import ConfigurationError, RecordingError
from spiked.recording import (
    ClockPair,
    Gap,
    Recording,
    RecordingGeometry,
    RecordingWriter,
    open_recording,
    read_sidecar,
    sidecar_path,
)
from spiked.recording.arrays import SpikeArray, is_array, open_array, open_bits
from spiked.recording.geometry import DEFAULT_RATE_HZ, Assumable, orientation_questions
from spiked.sensor import Layout, Sensor
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import output, report_warning

_BLOCK_BYTES = 1 << 20
"""Bytes read at a time."""
_CHUNK_FRAMES = 64
"""Frames written at a time."""


class Form(StrEnum):
    """How frames are stored in a file."""

    COMPACT = "compact"
    ROW_TAGGED = "row_tagged"
    USB = "usb"
    PCIE = "pcie"
    ARRAY = "array"
    """An array of NumPy or HDF5; read only."""
    BITS = "bits"
    """The bits of a frame one after the other, without an end of a row; read only."""


READ_ONLY = (Form.ARRAY, Form.BITS)
"""Forms that are not written."""


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


Item = NDArray[np.uint8] | Gap
"""Compact frames, uint8 [n, frame_bytes], LSB first, or a loss between them."""


@dataclass(frozen=True)
class Content:
    """What an input holds: compact frames and gaps in the order of the capture, of this camera."""

    sensor: Sensor
    items: Iterator[Item]
    sidecar: dict[str, Any]
    """Further fields for a sidecar."""
    clock: tuple[ClockPair, ...] = ()
    assumed: tuple[Assumable, ...] = ()
    """Properties of the sensor that nobody stated."""


class Writer(Protocol):
    """The file that is written."""

    def frames(self, frames: NDArray[np.uint8]) -> None: ...
    def gap(self, gap: Gap) -> None: ...
    def close(self) -> None: ...


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
    width: g.Width = None,
    height: g.Height = None,
    rate: g.Rate = None,
    layout: g.FrameLayout = None,
    bit_order: g.Bits = None,
    flipped: g.Flipped = None,
    mosaic: g.Colours = None,
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
    given = RecordingGeometry(width, height, rate, layout, bit_order, flipped, mosaic)
    content = read_content(source, source_form, given, array)
    for question in orientation_questions(content.assumed, content.sensor):
        report_warning(question)
    count, lost = write_content(content, out, to)
    size = f"{content.sensor.width}x{content.sensor.height}"
    output.print(f"{out}: {count} frames of {size}, {lost} lost, {to}", markup=False)


def read_content(path: Path, form: Form | None, given: RecordingGeometry, array: str | None = None) -> Content:
    """Open any form; `array` is the name of one. Raises RecordingError or ConfigurationError."""
    form = form or _detect_form(path)
    if array is not None and form is not Form.ARRAY:
        raise ConfigurationError(f"--array names an array of a file, and {path} is none")
    match form:
        case Form.ARRAY:
            found = open_array(path, array, given.width, given.bit_order)
            if given.height not in (None, found.height):
                raise ConfigurationError(f"{path}: its array has {found.height} rows, not {given.height}")
            return _array_content(found, given, flipped=False)
        case Form.BITS:
            if given.width is None or given.height is None:
                raise ConfigurationError(f"{path}: of frames without rows give --width and --height")
            return _array_content(open_bits(path, given.width, given.height, given.bit_order), given, flipped=True)
        case Form.USB:
            sensor = _wire_sensor(given, USB_WIDTH, USB_HEIGHT)
            return _wire_content(path, UsbFraming, sensor, given.unstated(("frame_rate",)))
        case Form.PCIE:
            sensor = _wire_sensor(given, PCIE_SIZE, PCIE_SIZE)
            return _wire_content(path, PcieFraming, sensor, given.unstated(("frame_rate", "flipped")))
        case Form.COMPACT | Form.ROW_TAGGED:
            given = replace(given, layout=Layout.COMPACT if form is Form.COMPACT else Layout.ROW_TAGGED)
    recording = open_recording(path, **given.stated())
    for warning in recording.warnings:
        report_warning(warning)
    fields = _sidecar_fields(recording)
    return Content(recording.sensor, _recorded(recording), fields, recording.clock, recording.assumed)


def _array_content(found: SpikeArray, given: RecordingGeometry, flipped: bool) -> Content:
    if given.layout is not None:
        raise ConfigurationError("--layout is of recordings: leave it out")
    if found.width < found.columns:
        left_out = found.columns - found.width
        report_warning(f"{left_out} of {found.columns} columns are left out: a recording has a multiple of 8")
    if found.trailing_bytes:
        report_warning(f"the last {found.trailing_bytes} bytes are less than a frame and are left out")
    sensor = Sensor(
        found.width,
        found.height,
        given.frame_rate_hz or DEFAULT_RATE_HZ,
        flipped=flipped if given.flipped is None else given.flipped,
        mosaic=given.mosaic,
    )
    return Content(sensor, found.blocks(), {}, assumed=given.unstated(("frame_rate", "flipped")))


def write_content(content: Content, out: Path, to: Form) -> tuple[int, int]:
    """Write frames and gaps to a new file; returns the numbers of frames and of lost frames.

    Nothing is left of a file that could not be written whole.
    """
    first = next(content.items, None)
    if first is None:
        raise RecordingError("the input holds no whole frame; if its form was detected wrongly, give it with --from")
    count = lost = 0
    with ExitStack() as stack:
        writer = _writer(content, out, to)
        stack.push(_remover(out))
        stack.callback(writer.close)
        for item in chain([first], content.items):
            if isinstance(item, Gap):
                writer.gap(item)
                lost += item.count
            else:
                writer.frames(item)
                count += len(item)
    return count, lost


def _remover(out: Path) -> Callable[[type[BaseException] | None, BaseException | None, Any], None]:
    """The end of a context that removes `out` and its sidecar after an error."""

    def remove(kind: type[BaseException] | None, error: BaseException | None, traceback: Any) -> None:
        if kind is not None:
            out.unlink(missing_ok=True)
            sidecar_path(out).unlink(missing_ok=True)

    return remove


def _detect_form(path: Path) -> Form | None:
    """The form of an array or of raw camera bytes; None for a recording."""
    if not path.is_file():
        return None
    try:
        head = np.fromfile(path, np.uint8, _BLOCK_BYTES)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}; check its permissions") from error
    if is_array(head[:8].tobytes()):
        return Form.ARRAY
    if sidecar_path(path).exists():
        return None
    framings: dict[Form, Callable[[], Framing]] = {Form.USB: UsbFraming, Form.PCIE: PcieFraming}
    for form, make in framings.items():
        if next(_parsed(make(), [head], _frame_bytes(form)), None) is not None:
            return form
    return None


def _frame_bytes(form: Form) -> int:
    return (USB_WIDTH * USB_HEIGHT if form is Form.USB else PCIE_SIZE * PCIE_SIZE) // 8


def _wire_sensor(given: RecordingGeometry, width: int, height: int) -> Sensor:
    if given.width not in (None, width) or given.height not in (None, height) or given.layout or given.bit_order:
        raise ConfigurationError(
            f"raw bytes of this camera are always {width}x{height}, in a fixed layout: leave out size, layout and "
            "bit order, or give the form of the file with --from"
        )
    flipped = True if given.flipped is None else given.flipped
    return Sensor(width, height, given.frame_rate_hz or DEFAULT_RATE_HZ, flipped=flipped, mosaic=given.mosaic)


def _wire_content(path: Path, make: Callable[[], Framing], sensor: Sensor, assumed: tuple[Assumable, ...]) -> Content:
    if not path.is_file() or path.stat().st_size == 0:
        raise RecordingError(f"{path}: not a file, or empty; check the path")
    data = np.memmap(path, np.uint8, "r")
    blocks = (np.asarray(data[start : start + _BLOCK_BYTES]) for start in range(0, data.size, _BLOCK_BYTES))
    return Content(sensor, _reported(make(), blocks, sensor.frame_bytes), {}, assumed=assumed)


def _reported(framing: Framing, blocks: Iterator[NDArray[np.uint8]], frame_bytes: int) -> Iterator[Item]:
    yield from _parsed(framing, blocks, frame_bytes)
    c = framing.counters
    if c.skipped_bytes or c.duplicates:
        report_warning(
            f"{c.skipped_bytes} bytes belong to no frame ({c.resyncs} resynchronisations); {c.duplicates} repeated "
            "frames were left out"
        )


def _parsed(
    framing: Framing, blocks: Iterator[NDArray[np.uint8]] | list[NDArray[np.uint8]], frame_bytes: int
) -> Iterator[Item]:
    view = np.empty((_CHUNK_FRAMES, frame_bytes), np.uint8)
    for block in chain(blocks, [None]):
        if block is None:
            framing.finish()
        else:
            framing.feed(block)
        while (item := framing.read_into(view)) is not None:
            if isinstance(item, Chunk):
                yield view[: item.frames]
            else:
                yield Gap(first=item.first, count=item.count, cause=str(item.cause))


def _recorded(recording: Recording) -> Iterator[Item]:
    stored = lost = 0
    for gap in sorted(recording.gaps, key=lambda gap: gap.first):
        yield from _frames_between(recording, stored, gap.first - lost)
        stored = min(gap.first - lost, recording.frames)
        lost += gap.count
        yield gap
    yield from _frames_between(recording, stored, recording.frames)


def _frames_between(recording: Recording, first: int, stop: int) -> Iterator[Item]:
    stop = min(stop, recording.frames)
    for start in range(first, stop, _CHUNK_FRAMES):
        yield recording.compact(start, min(_CHUNK_FRAMES, stop - start))


def _sidecar_fields(recording: Recording) -> dict[str, Any]:
    beside = sidecar_path(recording.path)
    if not beside.exists():
        return {}
    sidecar = read_sidecar(beside)
    fields: dict[str, Any] = {**(sidecar.model_extra or {}), "note": sidecar.note}
    if sidecar.device is not None:
        fields["device"] = sidecar.device
    if sidecar.calibration is not None:
        fields["calibration"] = str((beside.parent / sidecar.calibration).resolve())
    return fields


class _RecordingFile:
    def __init__(self, content: Content, out: Path, layout: Layout) -> None:
        fields = {**content.sidecar, "assumed": content.assumed}
        if "calibration" in fields:
            fields["calibration"] = os.path.relpath(fields["calibration"], out.resolve().parent)
        self._writer = RecordingWriter(out, replace(content.sensor, layout=layout), **fields)
        for pair in content.clock:
            self._writer.clock_pair(pair.frame, pair.unix_ns)

    def frames(self, frames: NDArray[np.uint8]) -> None:
        self._writer.append(frames)

    def gap(self, gap: Gap) -> None:
        self._writer.gap(gap.first, gap.count, gap.cause)

    def close(self) -> None:
        self._writer.close()


class _WireFile:
    """Raw bytes of a camera. The usb counters show gaps between frames; pcie has no counters."""

    def __init__(self, sensor: Sensor, out: Path, form: Form) -> None:
        size = (USB_WIDTH, USB_HEIGHT) if form is Form.USB else (PCIE_SIZE, PCIE_SIZE)
        if (sensor.width, sensor.height) != size:
            raise ConfigurationError(
                f"{form} bytes are {size[0]}x{size[1]}, but the input is {sensor.width}x{sensor.height}; "
                "choose another --to"
            )
        self._form = form
        self._next = 0
        self._written = 0
        self._pending = 0  # lost since the last frame
        self._unmarked = 0
        try:
            self._file = out.open("xb")
        except FileExistsError as error:
            raise RecordingError(f"{out} exists; choose another name or remove it") from error
        except OSError as error:
            raise RecordingError(f"{out} cannot be written: {error.strerror}; choose another place") from error

    def frames(self, frames: NDArray[np.uint8]) -> None:
        encoded = encode_usb(frames, first=self._next) if self._form is Form.USB else encode_pcie(frames)
        try:
            self._file.write(encoded.data)
            self._file.flush()
        except OSError as error:
            raise RecordingError(f"{self._file.name}: cannot be written: {error.strerror}; free some space") from error
        if self._form is Form.PCIE or not self._written:
            self._unmarked += self._pending
        self._pending = 0
        self._written += len(frames)
        self._next += len(frames)

    def gap(self, gap: Gap) -> None:
        self._pending += gap.count
        self._next += gap.count

    def close(self) -> None:
        self._file.close()
        unmarked = self._unmarked + self._pending
        if unmarked:
            report_warning(f"{unmarked} lost frames cannot be marked in {self._form} bytes")


def _writer(content: Content, out: Path, to: Form) -> Writer:
    match to:
        case Form.COMPACT:
            return _RecordingFile(content, out, Layout.COMPACT)
        case Form.ROW_TAGGED:
            return _RecordingFile(content, out, Layout.ROW_TAGGED)
        case _:
            return _WireFile(content.sensor, out, to)
