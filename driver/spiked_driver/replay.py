"""Replays a recording as a camera."""

from bisect import bisect_right
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WithJsonSchema, field_validator

from spiked.camera import StoredCameraOptions
from spiked.errors import SourceError
from spiked.recording import Recording, RecordingGeometry, open_recording
from spiked.recording.geometry import Assumable
from spiked.ring import DeviceState, DeviceStatus, End, EndReason, Gap, LossCause
from spiked.sensor import BitOrder, Sensor
from spiked_driver.fault_options import MOST_FRAMES
from spiked_driver.source import Chunk, Pacer, former_source_names
from spiked_driver.source_kind import Device, PacedOptions, SourceKind, SourceOptions, SourceSpec, Warn, path_of

_Index = Annotated[int, Field(ge=0, le=MOST_FRAMES)]
_Range = Annotated[tuple[_Index | None, _Index | None], WithJsonSchema({"type": "string", "pattern": r"^\d*:\d*$"})]


class ReplayOptions(PacedOptions, SourceOptions, StoredCameraOptions):
    """Options of `replay:FILE`. What they state of the camera wins over the sidecar."""

    repeat: int = Field(1, ge=1, le=10**6)
    """Number of times the range is played."""
    range: _Range = (None, None)
    """`FIRST:STOP`: frames FIRST to STOP - 1; either may be omitted."""

    @field_validator("range", mode="before")
    @classmethod
    def _bounds(cls, value: Any) -> Any:
        return [part or None for part in value.split(":")] if isinstance(value, str) else value


@former_source_names
class ReplaySource:
    """Frames `first` to `stop - 1` of a recording, `repeat` times. The index starts at 0 and continues over repeats.

    `first` and `stop` count stored frames. Frames that the recording lost are gaps with the same cause. `pace` is a
    factor of the recorded rate; with 0, frames come as fast as lossless consumers take them.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        pace: float = 1.0,
        repeat: int = 1,
        first: int = 0,
        stop: int | None = None,
    ) -> None:
        last = recording.frames if stop is None else stop
        if not 0 <= first < last <= recording.frames:
            raise SourceError(f"range {first}:{last} is not within the {recording.frames} frames of {recording.path}")
        if pace < 0 or repeat < 1:
            raise SourceError(
                f"a replay at pace {pace:g}, {repeat} times, is not possible: pace must be >= 0 and repeat >= 1"
            )
        self._recording = recording
        self._pieces = _pieces(recording, first, last)
        self._length = sum(piece.count for piece in self._pieces)
        self._repeat = repeat
        self._pace = pace
        self._pacer = Pacer(self.sensor.frame_rate_hz, pace)
        self._next = 0
        self._device_status = DeviceStatus(DeviceState.IDLE)

    @property
    def path(self) -> Path:
        """The recording's file."""
        return self._recording.path

    @property
    def assumed(self) -> tuple[Assumable, ...]:
        """Properties of the sensor that nobody stated."""
        return self._recording.assumed

    @property
    def sensor(self) -> Sensor:
        """The recording's sensor with compact frames, leftmost pixel in the lowest bit."""
        return replace(self._recording.sensor.compact(), bit_order=BitOrder.LSB)

    @property
    def frames(self) -> int:
        """Frames of all repeats, with lost ones."""
        return self._length * self._repeat

    @property
    def can_block(self) -> bool:
        """Without a pace only: a paced replay behaves like a camera, which does not wait."""
        return self._pace == 0

    @property
    def device_status(self) -> DeviceStatus:
        """Armed once open, streaming from the first frame, idle after the last."""
        return self._device_status

    def open(self) -> None:
        """Start again at frame 0."""
        self._next = 0
        self._pacer = Pacer(self.sensor.frame_rate_hz, self._pace)
        self._device_status = DeviceStatus(DeviceState.ARMED)

    def close(self) -> None:
        """Stop. The recording stays open; its owner closes it."""
        self._device_status = DeviceStatus(DeviceState.IDLE)

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`; a chunk ends where a repeat or the recording's next gap begins."""
        if self._next == self.frames:
            self._device_status = DeviceStatus(DeviceState.IDLE, "the recording has ended")
            return End(self.frames, EndReason.FINISHED)
        position = self._next % self._length
        piece = self._pieces[bisect_right(self._pieces, position, key=lambda piece: piece.start) - 1]
        skip = position - piece.start
        count = piece.count if piece.cause else min(len(view), piece.count - skip)
        if not self._pacer.wait_for(self._next + count):
            return None
        first = self._next
        self._next += count
        self._device_status = DeviceStatus(DeviceState.STREAMING)
        if piece.cause:
            return Gap(first, count, piece.cause)
        view[:count] = self._recording.compact(piece.stored + skip, count)
        return Chunk(first, count)


@dataclass(frozen=True)
class _Piece:
    """Consecutive frames of the range that are all stored, or all lost for the same cause."""

    start: int
    """Index of the first frame, counted from the start of the range."""
    count: int
    stored: int
    """Index in the file of the first frame; of a loss, of the frame after it."""
    cause: LossCause | None = None
    """Cause of the loss; None for stored frames."""


def _pieces(recording: Recording, first: int, stop: int) -> list[_Piece]:
    """Pieces of the range in order. A gap at an end of the range belongs to it only at an end of the recording."""
    pieces: list[_Piece] = []
    start, stored, lost_before = 0, first, 0
    for gap in sorted(recording.gaps, key=lambda gap: gap.first):
        place = gap.first - lost_before
        lost_before += gap.count
        if not (first < place < stop or place == first == 0 or place == stop == recording.frames):
            continue
        if place > stored:
            pieces.append(_Piece(start, place - stored, stored))
            start, stored = start + place - stored, place
        pieces.append(_Piece(start, gap.count, stored, _cause(recording, gap.cause)))
        start += gap.count
    if stop > stored:
        pieces.append(_Piece(start, stop - stored, stored))
    return pieces


def _cause(recording: Recording, text: str) -> LossCause:
    try:
        return LossCause(text)
    except ValueError as error:
        known = ", ".join(LossCause)
        raise SourceError(f"the sidecar of {recording.path} has a gap of cause {text!r}; causes are {known}") from error


def _open(spec: SourceSpec, options: ReplayOptions, warn: Warn | None) -> ReplaySource:
    recording = open_recording(path_of(spec, KIND.usage), **RecordingGeometry.of(options).stated())
    recording = replace(recording, sensor=options.sensor(recording.sensor))
    first, stop = options.range
    return ReplaySource(recording, pace=options.pace, repeat=options.repeat, first=first or 0, stop=stop)


def _describe(spec: SourceSpec) -> Device:
    return Device(spec.text, KIND.name, "configured with --device")


def _recording_of(spec: SourceSpec) -> Path:
    return Path(path_of(spec, KIND.usage))


KIND = SourceKind(
    name="replay",
    usage="replay:FILE",
    summary="a recording, replayed as a camera",
    options=ReplayOptions,
    open=_open,
    describe=_describe,
    assumed=lambda source, options: source.assumed,
    recording_of=_recording_of,
    can_block=True,
    takes_path=True,
)
