"""What a file holds: frames of a recording, of raw camera bytes, or of an array of spikes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from spiked_driver.framing import USB_HEIGHT, USB_WIDTH, Framing, UsbFraming
from spiked_driver.pcie import PCIE_SIZE, PcieFraming
from spiked_driver.source import Chunk

from spiked.errors import ConfigurationError, RecordingError
from spiked.recording import ClockPair, Gap, Recording, RecordingGeometry, open_recording, read_sidecar, sidecar_path
from spiked.recording.arrays import SpikeArray, is_array, open_array, open_bits
from spiked.recording.geometry import DEFAULT_RATE_HZ, Assumable
from spiked.sensor import Layout, Response, Sensor
from spiked_service.conversion.form import Form

_BLOCK_BYTES = 1 << 20
"""Bytes read at a time."""
_CHUNK_FRAMES = 64
"""Frames read at a time."""


Warn = Callable[[str], None]
"""Takes a sentence for the user."""
Item = NDArray[np.uint8] | Gap
"""Compact frames, uint8 [n, frame_bytes], LSB first, or a loss between them."""


@dataclass(frozen=True)
class Content:
    """What an input holds: compact frames and gaps in the order of the capture, of this camera."""

    sensor: Sensor
    items: Iterator[Item]
    sidecar: dict[str, Any]
    """Further fields for a sidecar."""
    most_frames: int
    """More frames are not read."""
    clock: tuple[ClockPair, ...] = ()
    assumed: tuple[Assumable, ...] = ()
    """Properties of the sensor that nobody stated."""

    @property
    def most_bytes(self) -> int:
        """Upper bound of the compact frames."""
        return self.most_frames * self.sensor.compact().frame_bytes


def read_content(
    path: Path, form: Form | None, given: RecordingGeometry, warn: Warn, array: str | None = None
) -> Content:
    """Open any form; None: detected. `array` is the name of one. Raises RecordingError or ConfigurationError."""
    form = form or detect_form(path)
    if array is not None and form is not Form.ARRAY:
        raise ConfigurationError(f"{array!r} names an array of a file, and {path} holds none: leave the name out")
    match form:
        case Form.ARRAY:
            found = open_array(path, array, given.width, given.bit_order)
            if given.height not in (None, found.height):
                raise ConfigurationError(f"{path}: its array has {found.height} rows, not {given.height}")
            return _array_content(found, given, warn, flipped=False)
        case Form.BITS:
            if given.width is None or given.height is None:
                raise ConfigurationError(f"{path}: of frames without rows give the width and the height")
            found = open_bits(path, given.width, given.height, given.bit_order)
            return _array_content(found, given, warn, flipped=True)
        case Form.USB:
            sensor = _wire_sensor(given, USB_WIDTH, USB_HEIGHT)
            return _wire_content(path, UsbFraming, sensor, warn, given.unstated(("frame_rate",)))
        case Form.PCIE:
            sensor = _wire_sensor(given, PCIE_SIZE, PCIE_SIZE)
            return _wire_content(path, PcieFraming, sensor, warn, given.unstated(("frame_rate", "flipped")))
        case Form.COMPACT | Form.ROW_TAGGED:
            given = replace(given, layout=Layout.COMPACT if form is Form.COMPACT else Layout.ROW_TAGGED)
    recording = open_recording(path, **given.stated())
    for warning in recording.warnings:
        warn(warning)
    fields = _sidecar_fields(recording)
    frames = recording.frames
    return Content(recording.sensor, _recorded(recording), fields, frames, recording.clock, recording.assumed)


def _array_content(found: SpikeArray, given: RecordingGeometry, warn: Warn, flipped: bool) -> Content:
    if given.layout is not None:
        raise ConfigurationError("a layout is of recordings: leave it out")
    if found.width < found.columns:
        left_out = found.columns - found.width
        warn(f"{left_out} of {found.columns} columns are left out: a recording has a multiple of 8")
    if found.trailing_bytes:
        warn(f"the last {found.trailing_bytes} bytes are less than a frame and are left out")
    is_cube = found.packed is not None and not flipped
    if is_cube and given.response is None:
        warn(f"a photon cube: its response is taken as {Response.BERNOULLI}; of a spike camera state another")
    sensor = Sensor(
        found.width,
        found.height,
        given.frame_rate_hz or DEFAULT_RATE_HZ,
        flipped=flipped if given.flipped is None else given.flipped,
        mosaic=given.mosaic,
        response=given.response or (Response.BERNOULLI if is_cube else Response.INTEGRATE_AND_FIRE),
    )
    return Content(sensor, found.blocks(), {}, found.frames, assumed=given.unstated(("frame_rate", "flipped")))


def detect_form(path: Path) -> Form | None:
    """The form of an array or of raw camera bytes; None for a recording. Raises RecordingError."""
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
            "bit order, or give the form of the file"
        )
    flipped = True if given.flipped is None else given.flipped
    return Sensor(
        width,
        height,
        given.frame_rate_hz or DEFAULT_RATE_HZ,
        flipped=flipped,
        mosaic=given.mosaic,
        response=given.response or Response.INTEGRATE_AND_FIRE,
    )


def _wire_content(
    path: Path, make: Callable[[], Framing], sensor: Sensor, warn: Warn, assumed: tuple[Assumable, ...]
) -> Content:
    if not path.is_file() or path.stat().st_size == 0:
        raise RecordingError(f"{path}: not a file, or empty; check the path")
    data = np.memmap(path, np.uint8, "r")
    blocks = (np.asarray(data[start : start + _BLOCK_BYTES]) for start in range(0, data.size, _BLOCK_BYTES))
    items = _reported(make(), blocks, sensor.frame_bytes, warn)
    return Content(sensor, items, {}, data.size // sensor.frame_bytes, assumed=assumed)


def _reported(framing: Framing, blocks: Iterator[NDArray[np.uint8]], frame_bytes: int, warn: Warn) -> Iterator[Item]:
    yield from _parsed(framing, blocks, frame_bytes)
    c = framing.counters
    if c.skipped_bytes or c.duplicates:
        warn(
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
    fields: dict[str, Any] = {**(sidecar.model_extra or {}), "note": sidecar.note, "first_frame": sidecar.first_frame}
    if sidecar.profile is not None:
        fields["profile"] = sidecar.profile
    if sidecar.device is not None:
        fields["device"] = sidecar.device
    if sidecar.calibration is not None:
        fields["calibration"] = str((beside.parent / sidecar.calibration).resolve())
    return fields
