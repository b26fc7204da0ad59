"""Writes frames and gaps in any form that is written."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray
from spiked_driver.framing import USB_HEIGHT, USB_WIDTH, encode_usb
from spiked_driver.pcie import PCIE_SIZE, encode_pcie

from spiked.errors import ConfigurationError, RecordingError
from spiked.recording import Gap, RecordingWriter, whole_recording
from spiked.sensor import Layout, Sensor
from spiked.whole_files import whole_file
from spiked_service.conversion.form import RECORDINGS, Form
from spiked_service.conversion.reading import Content, Warn


class Writer(Protocol):
    """The file that is written."""

    def frames(self, frames: NDArray[np.uint8]) -> None: ...
    def gap(self, gap: Gap) -> None: ...


def write_content(content: Content, out: Path, to: Form, warn: Warn) -> tuple[int, int]:
    """Write frames and gaps to a new file; returns the numbers of frames and of lost frames.

    Nothing is left of a file that could not be written whole.
    """
    first = next(content.items, None)
    if first is None:
        raise RecordingError("the input holds no whole frame; if its form was detected wrongly, state the form")
    count = lost = 0
    opened = _recording(content, out, Layout(to)) if to in RECORDINGS else _wire_file(content.sensor, out, to, warn)
    with opened as writer:
        for item in chain([first], content.items):
            if isinstance(item, Gap):
                writer.gap(item)
                lost += item.count
            else:
                writer.frames(item)
                count += len(item)
    return count, lost


@contextmanager
def _recording(content: Content, out: Path, layout: Layout) -> Iterator[Writer]:
    fields = {**content.sidecar, "assumed": content.assumed}
    if "calibration" in fields:
        fields["calibration"] = os.path.relpath(fields["calibration"], out.resolve().parent)
    with whole_recording(out, replace(content.sensor, layout=layout), **fields) as writer:
        for pair in content.clock:
            writer.clock_pair(pair.frame, pair.unix_ns)
        yield _RecordingFile(writer)


@contextmanager
def _wire_file(sensor: Sensor, out: Path, form: Form, warn: Warn) -> Iterator[Writer]:
    """A part of raw bytes would pass for fewer of them: they have no sidecar, and the file appears when it is whole."""
    size = (USB_WIDTH, USB_HEIGHT) if form is Form.USB else (PCIE_SIZE, PCIE_SIZE)
    if (sensor.width, sensor.height) != size:
        raise ConfigurationError(
            f"{form} bytes are {size[0]}x{size[1]}, but the input is {sensor.width}x{sensor.height}; "
            "choose another form to write"
        )
    if out.exists():
        raise RecordingError(f"{out} exists; choose another name or remove it")
    try:
        with whole_file(out) as part, part.open("wb") as file:
            writer = _WireFile(file, form)
            yield writer
    except OSError as error:
        why = f"{out} cannot be written: {error.strerror}; free some space, or choose another place"
        raise RecordingError(why) from error
    if writer.unmarked:
        warn(f"{writer.unmarked} lost frames cannot be marked in {form} bytes")


class _RecordingFile:
    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer

    def frames(self, frames: NDArray[np.uint8]) -> None:
        self._writer.append(frames)

    def gap(self, gap: Gap) -> None:
        self._writer.gap(gap.first, gap.count, gap.cause)


class _WireFile:
    """Raw bytes of a camera. The usb counters show gaps between frames; pcie has no counters."""

    def __init__(self, file: BinaryIO, form: Form) -> None:
        self._file, self._form = file, form
        self._next = 0
        self.unmarked = 0
        """Lost frames that the bytes do not show."""
        self._pending = 0  # lost since the last frame
        self._begun = False

    def frames(self, frames: NDArray[np.uint8]) -> None:
        encoded = encode_usb(frames, first=self._next) if self._form is Form.USB else encode_pcie(frames)
        self._file.write(encoded.data)
        if self._begun and self._form is Form.USB:
            self.unmarked -= self._pending  # the counters have jumped
        self._pending, self._begun = 0, True
        self._next += len(frames)

    def gap(self, gap: Gap) -> None:
        self._pending += gap.count
        self.unmarked += gap.count
        self._next += gap.count
