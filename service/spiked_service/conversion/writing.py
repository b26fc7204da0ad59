"""Writes frames and gaps in any form that is written."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from spiked_driver.framing import USB_HEIGHT, USB_WIDTH, encode_usb
from spiked_driver.pcie import PCIE_SIZE, encode_pcie

from spiked.errors import ConfigurationError, RecordingError
from spiked.recording import Gap, RecordingWriter, sidecar_path
from spiked.sensor import Layout, Sensor
from spiked_service.conversion.form import Form
from spiked_service.conversion.reading import Content, Warn


class Writer(Protocol):
    """The file that is written."""

    def frames(self, frames: NDArray[np.uint8]) -> None: ...
    def gap(self, gap: Gap) -> None: ...
    def close(self) -> None: ...


def write_content(content: Content, out: Path, to: Form, warn: Warn) -> tuple[int, int]:
    """Write frames and gaps to a new file; returns the numbers of frames and of lost frames.

    Nothing is left of a file that could not be written whole.
    """
    first = next(content.items, None)
    if first is None:
        raise RecordingError("the input holds no whole frame; if its form was detected wrongly, state the form")
    count = lost = 0
    with ExitStack() as stack:
        writer = _writer(content, out, to, warn)
        stack.enter_context(_removed_after_an_error(out, to))
        stack.callback(writer.close)
        for item in chain([first], content.items):
            if isinstance(item, Gap):
                writer.gap(item)
                lost += item.count
            else:
                writer.frames(item)
                count += len(item)
    return count, lost


@contextmanager
def _removed_after_an_error(out: Path, to: Form) -> Iterator[None]:
    """Raw bytes have no sidecar: one of that name is the source's, in the same folder."""
    try:
        yield
    except BaseException:
        out.unlink(missing_ok=True)
        if to in (Form.COMPACT, Form.ROW_TAGGED):
            sidecar_path(out).unlink(missing_ok=True)
        raise


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

    def __init__(self, sensor: Sensor, out: Path, form: Form, warn: Warn) -> None:
        size = (USB_WIDTH, USB_HEIGHT) if form is Form.USB else (PCIE_SIZE, PCIE_SIZE)
        if (sensor.width, sensor.height) != size:
            raise ConfigurationError(
                f"{form} bytes are {size[0]}x{size[1]}, but the input is {sensor.width}x{sensor.height}; "
                "choose another form to write"
            )
        self._form = form
        self._warn = warn
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
            self._warn(f"{unmarked} lost frames cannot be marked in {self._form} bytes")


def _writer(content: Content, out: Path, to: Form, warn: Warn) -> Writer:
    match to:
        case Form.COMPACT:
            return _RecordingFile(content, out, Layout.COMPACT)
        case Form.ROW_TAGGED:
            return _RecordingFile(content, out, Layout.ROW_TAGGED)
        case _:
            return _WireFile(content.sensor, out, to, warn)
