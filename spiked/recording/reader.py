"""Reading recordings by memory map."""

import mmap
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.blocks import unpack
from spiked.errors import ConfigurationError, RecordingError
from spiked.recording.arrays import is_array
from spiked.recording.geometry import (
    ASSUMABLE,
    DEFAULT_RATE_HZ,
    Assumable,
    Origin,
    OriginKind,
    RecordingGeometry,
    guess,
    orientation_questions,
    tags_agree,
)
from spiked.recording.host_time import host_times_ns
from spiked.recording.index import Index, index_path, read_index
from spiked.recording.sidecar import (
    ClockPair,
    Gap,
    Sidecar,
    find_spikecv_config,
    read_sidecar,
    read_spikecv_config,
    recorded_calibration,
    sidecar_path,
)
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Response, Sensor

REVERSED_BITS = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)[:, ::-1], axis=1)[:, 0]
"""Each byte with its bits reversed, uint8 [256]."""

_MAGICS = {
    b"\x89PNG\r\n\x1a\n": "a PNG picture",
    b"\xff\xd8\xff\xe0": "a JPEG picture",
    b"\xff\xd8\xff\xe1": "a JPEG picture",
    b"\xff\xd8\xff\xdb": "a JPEG picture",
    b"PK\x03\x04": "a ZIP archive",
    b"\x93NUMPY": "a NumPy array",
    b"\x89HDF\r\n\x1a\n": "an HDF5 file",
}

RELEASED_BYTES = 64 << 20
"""Bytes read after which the pages of the file are given back: otherwise all that was read counts as memory of the
process. They stay in the page cache."""
TAGS_CHECKED = 512
"""Frames whose row numbers are checked when a file is opened, spread evenly; `verify` checks all."""


@dataclass(frozen=True, eq=False)
class Recording:
    """An open recording. Frames are read from disk when they are accessed."""

    path: Path
    sensor: Sensor
    frames: int
    """Whole frames in the file."""
    origin: Origin
    """Source of the geometry."""
    warnings: tuple[str, ...]
    """Warnings for the user, one sentence each."""
    contradictions: tuple[str, ...]
    """Errors that make the file unusable; empty except in the result of `verify`."""
    overruled: tuple[str, ...]
    """Fields in which the caller overrides the sidecar, one sentence each; also among the warnings."""
    trailing_bytes: int
    """Bytes of an unfinished last frame."""
    gaps: tuple[Gap, ...]
    clock: tuple[ClockPair, ...]
    label_types: tuple[float, ...]
    """SpikeCV's ids of the label types, from a config.yaml."""
    data: NDArray[np.uint8]
    """The whole frames as stored, uint8 [frames, frame_bytes], a read-only memory map."""
    assumed: tuple[Assumable, ...] = ()
    """Properties of the sensor, by their names in a sidecar, that nobody stated: a default was taken."""
    _unreleased: list[int] = field(default_factory=lambda: [0], repr=False)
    """Bytes read since pages were given back, see `RELEASED_BYTES`."""

    @property
    def questions(self) -> tuple[str, ...]:
        """What nothing states and no pixel shows, and what was taken, one sentence each."""
        return orientation_questions(self.assumed, self.sensor)

    @property
    def seconds(self) -> float:
        """Length of the whole frames in the file."""
        return self.sensor.seconds(self.frames)

    def read(self, first: int, count: int) -> NDArray[np.uint8]:
        """Stored frames, uint8 [count, frame_bytes], a view of the memory map. Raises RecordingError out of range."""
        if first < 0 or count < 0 or first + count > self.frames:
            raise RecordingError(
                f"{self.path}: frames {first} to {first + count - 1} are not within its {self.frames} frames"
            )
        return self._rows(first, count)

    def _rows(self, first: int, count: int) -> NDArray[np.uint8]:
        """Stored frames; now and then pages of earlier ones are given back, which remain valid."""
        self._unreleased[0] += count * self.sensor.frame_bytes
        if self._unreleased[0] > RELEASED_BYTES:
            self._unreleased[0] = 0
            _release(self.data)
        return self.data[first : first + count]

    def compact(self, first: int, count: int) -> NDArray[np.uint8]:
        """Frames without row numbers and LSB first, in stored row order, uint8 [count, height * row_bytes].

        A view of the memory map if the file is stored in this format.
        """
        frames = self.read(first, count)
        if self.sensor.layout is Layout.ROW_TAGGED:
            rows = frames.reshape(count, self.sensor.height, self.sensor.row_stride)[:, :, : self.sensor.row_bytes]
            frames = rows.reshape(count, self.sensor.height * self.sensor.row_bytes)
        return REVERSED_BITS[frames] if self.sensor.bit_order is BitOrder.MSB else frames

    def images(self, first: int, count: int, *, out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Upright frames, uint8 [count, height, width] of 0 and 1, in `out` if given. Raises RecordingError."""
        return unpack(self.read(first, count), self.sensor, out=out)

    def frame(self, k: int) -> NDArray[np.bool_]:
        """One upright frame, bool [height, width]."""
        image: NDArray[np.bool_] = self.images(k, 1)[0].astype(np.bool_)
        return image

    def chunks(self, count: int = 256) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """All frames in order, as (index of the first, stored frames uint8 [<= count, frame_bytes])."""
        for first in range(0, self.frames, count):
            yield first, self.read(first, min(count, self.frames - first))

    def unix_ns(self, frames: ArrayLike) -> NDArray[np.int64]:
        """Host times at which frames had arrived whole, Unix time in ns, int64 of the shape of `frames`.

        `frames` are indices in the capture, see `capture_index`. Raises RecordingError without clock pairs.
        """
        if not self.clock:
            raise RecordingError(f"{self.path}: its sidecar has no clock pairs, so the times of its frames are unknown")
        return host_times_ns(self.clock, frames, self.sensor.frame_rate_hz)

    def capture_index(self, k: int) -> int:
        """Index in the capture of stored frame k: k plus the frames lost before it."""
        for gap in sorted(self.gaps, key=lambda gap: gap.first):
            if gap.first > k:
                break
            k += gap.count
        return k

    def unbroken(self, k: int) -> tuple[int, int]:
        """First and end of the stored frames around k between which none was lost."""
        begin = lost = 0
        for gap in sorted(self.gaps, key=lambda gap: gap.first):
            row = gap.first - lost
            if row > k:
                return begin, min(row, self.frames)
            begin, lost = row, lost + gap.count
        return begin, self.frames

    def captured(self, first: int, count: int) -> NDArray[np.uint8] | None:
        """Stored frames `first` to `first + count - 1` of the capture, uint8 [count, frame_bytes], a view of the memory
        map; None if one of them was lost or is not in the file."""
        row = first
        for gap in self.gaps:
            if gap.first < first + count and first < gap.first + gap.count:
                return None
            row -= gap.count if gap.first < first else 0
        return self._rows(row, count) if row >= 0 and row + count <= self.frames else None


def open_recording(
    path: str | os.PathLike[str],
    *,
    width: int | None = None,
    height: int | None = None,
    frame_rate_hz: float | None = None,
    layout: Layout | None = None,
    bit_order: BitOrder | None = None,
    flipped: bool | None = None,
    mosaic: Mosaic | None = None,
    intrinsics: Intrinsics | None = None,
    response: Response | None = None,
) -> Recording:
    """Open a `.dat` file. Geometry comes from the arguments, else the sidecar or SpikeCV's config.yaml, else the size.

    Raises RecordingError with one line about the error in the file, its sidecar or the arguments.
    """
    given = RecordingGeometry(width, height, frame_rate_hz, layout, bit_order, flipped, mosaic, intrinsics, response)
    recording = open_unchecked(Path(path), given)
    if recording.contradictions:
        raise RecordingError(f"{recording.path}: {recording.contradictions[0]}")
    return recording


def open_unchecked(path: Path, given: RecordingGeometry) -> Recording:
    """As `open_recording`, but contradictions are fields of the result and not raised."""
    data = _map(path)
    described = _describe(path, data, given)
    sensor = described.sensor
    frames, trailing = divmod(data.size, sensor.frame_bytes)
    if frames == 0:
        raise RecordingError(
            f"{path}: its {data.size} bytes are less than one frame of {sensor.width}x{sensor.height} "
            f"({sensor.frame_bytes} bytes); check the geometry"
        )
    warnings, contradictions = list(described.warnings), []
    if trailing:
        warnings.append(f"the last frame is truncated to {trailing} of {sensor.frame_bytes} bytes and is ignored")
    sidecar = described.sidecar
    if sidecar is not None and sidecar.calibration is not None and recorded_calibration(path) is None:
        warnings.append(f"its calibration {sidecar.calibration} is not there, so its rates are not corrected")
    gaps, clock = (sidecar.gaps, sidecar.clock) if sidecar else ((), ())
    if sidecar is not None and sidecar.frames is None:
        warnings.append("the recording was not finished: its sidecar has no number of frames")
        if (index := _index_of(path, sensor.frame_bytes, warnings)) is not None:
            gaps, clock = index.gaps(), index.clock()
    # A file cut within its last frame is a common interruption; any other difference means another file's sidecar.
    elif sidecar is not None and not given.states_size and sidecar.frames not in (frames, frames + (trailing > 0)):
        contradictions.append(
            f"its sidecar {sidecar_path(path).name} says {sidecar.frames} frames of {sensor.width}x{sensor.height}, "
            f"but the file's {data.size} bytes hold {frames}; correct the sidecar or state the geometry"
        )
    ordered = sorted(gaps, key=lambda gap: gap.first)
    for one, other in pairwise(ordered):
        if other.first < one.first + one.count:
            contradictions.append(
                f"its gaps of {one.count} frames from {one.first} on and of {other.count} from {other.first} on "
                f"overlap; correct the sidecar {sidecar_path(path).name}"
            )
    whole = data[: frames * sensor.frame_bytes].reshape(frames, sensor.frame_bytes)
    if sensor.layout is Layout.ROW_TAGGED:
        samples = np.unique(np.linspace(0, frames - 1, min(frames, TAGS_CHECKED)).astype(int))
        wrong = samples[~tags_agree(whole[samples], sensor.height, sensor.row_bytes)]
        if len(wrong):
            contradictions.append(
                f"the row numbers of frame {wrong[0]} are not 0..{sensor.height - 1}: the file is not row-tagged "
                f"{sensor.width}x{sensor.height} or is damaged; check layout and geometry"
            )
    clock = _in_order(clock, warnings)
    return Recording(
        path,
        sensor,
        frames,
        described.origin,
        tuple(warnings),
        tuple(contradictions),
        described.overruled,
        trailing,
        gaps,
        clock,
        described.label_types,
        whole,
        described.assumed,
    )


def _index_of(path: Path, frame_bytes: int, warnings: list[str]) -> Index | None:
    """The index of a recording that was not finished: its gaps are in no sidecar yet."""
    if not index_path(path).exists():
        return None
    try:
        found = read_index(index_path(path))
    except RecordingError as error:
        warnings.append(f"{error}; its gaps are not known")
        return None
    return found if found.frame_bytes == frame_bytes else None


def _in_order(clock: Sequence[ClockPair], warnings: list[str]) -> tuple[ClockPair, ...]:
    """Clock pairs whose frames increase: others say nothing of the rate."""
    kept: list[ClockPair] = []
    for pair in clock:
        if not kept or pair.frame > kept[-1].frame:
            kept.append(pair)
    if len(kept) < len(clock):
        warnings.append(f"{len(clock) - len(kept)} of its {len(clock)} clock pairs are out of order and are left out")
    return tuple(kept)


def _map(path: Path) -> NDArray[np.uint8]:
    """The file's bytes, uint8 [size], without loading them."""
    try:
        if path.is_dir():
            raise RecordingError(f"{path}: this is a directory; name the .dat file in it")
        with path.open("rb") as file:
            head = file.read(16)
            for magic, what in _MAGICS.items():
                if head.startswith(magic):
                    hint = ": `spiked convert` reads arrays of spikes" if is_array(head) else ""
                    raise RecordingError(f"{path}: this is {what}, not a recording{hint}")
            if not head:
                raise RecordingError(f"{path}: the file is empty")
            return np.asarray(np.memmap(file, np.uint8, "r"))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error


def _release(data: NDArray[np.uint8]) -> None:
    """Give the pages of a memory map that were read back to the kernel; they are read again when they are accessed."""
    base: object = data
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)


@dataclass(frozen=True)
class _Description:
    sensor: Sensor
    origin: Origin
    assumed: tuple[Assumable, ...] = ()
    warnings: tuple[str, ...] = ()
    overruled: tuple[str, ...] = ()
    sidecar: Sidecar | None = None
    label_types: tuple[float, ...] = ()


def _describe(path: Path, data: NDArray[np.uint8], given: RecordingGeometry) -> _Description:
    described = _from_sidecar(path, given) or _from_spikecv(path, given) or _from_size(path, data, given)
    fields = given.stated()
    if not fields or described.origin.kind is not OriginKind.SIDECAR:
        return described
    sensor = _replaced(path, described.sensor, fields)
    changed = [name for name in fields if getattr(sensor, name) != getattr(described.sensor, name)]
    if not changed:
        return described
    overrides = ", ".join(f"{name} {getattr(sensor, name)} (not {getattr(described.sensor, name)})" for name in changed)
    origin = Origin(OriginKind.GIVEN, f"{overrides} as given, the rest {described.origin.sentence}")
    overruled = f"stated geometry contradicts the sidecar: {overrides}"
    warnings = (*described.warnings, overruled)
    if {"width", "height"} & set(changed) and sensor.intrinsics is not None and given.intrinsics is None:
        of = described.sensor
        sensor = replace(sensor, intrinsics=None)
        warnings += (
            f"the sidecar's optics are for {of.width}x{of.height} and are ignored; give --fov or --intrinsics",
        )
    return replace(described, sensor=sensor, origin=origin, warnings=warnings, overruled=(overruled,))


def _replaced(path: Path, sensor: Sensor, fields: dict[str, object]) -> Sensor:
    try:
        return replace(sensor, **fields)  # type: ignore[arg-type]
    except ConfigurationError as error:
        raise RecordingError(f"{path}: {error}") from error


def _from_sidecar(path: Path, given: RecordingGeometry) -> _Description | None:
    beside = sidecar_path(path)
    if not beside.exists():
        return None
    sidecar = read_sidecar(beside)
    assumed = given.unstated(sidecar.assumed)
    sentence = f"from the sidecar {beside.name}{f'; {_sentence(assumed, sidecar.sensor())}' if assumed else ''}"
    return _Description(sidecar.sensor(), Origin(OriginKind.SIDECAR, sentence), assumed, sidecar=sidecar)


def _from_spikecv(path: Path, given: RecordingGeometry) -> _Description | None:
    if given.width is not None and given.height is not None:
        return None
    beside = find_spikecv_config(path)
    config = read_spikecv_config(beside) if beside else None
    if beside is None or config is None:
        return None
    sensor = _replaced(path, Sensor(8, 1, DEFAULT_RATE_HZ), {"width": config.spike_w, "height": config.spike_h})
    assumed = given.unstated(ASSUMABLE)
    size = f"{sensor.width}x{sensor.height} from SpikeCV's {beside.name}, which knows sizes only"
    origin = Origin(OriginKind.SIDECAR, f"{size}; {_sentence(assumed, sensor)}")
    return _Description(sensor, origin, assumed, label_types=config.labeled_data_type)


def _from_size(path: Path, data: NDArray[np.uint8], given: RecordingGeometry) -> _Description:
    if (given.width is None) != (given.height is None):
        raise RecordingError(f"{path}: give both width and height, or neither")
    assumed = given.unstated(ASSUMABLE)
    if given.width is not None:
        sensor = _replaced(path, Sensor(8, 1, DEFAULT_RATE_HZ), given.stated())
        origin = Origin(OriginKind.GIVEN, f"{sensor.width}x{sensor.height} as given; {_sentence(assumed, sensor)}")
        return _Description(sensor, origin, assumed)
    flavour = guess(str(path), data)
    fields = {"width": flavour.width, "height": flavour.height, "layout": flavour.layout, **given.stated()}
    sensor = _replaced(path, Sensor(8, 1, DEFAULT_RATE_HZ), fields)
    sentence = f"{flavour.name}, the only known flavour that fits the file; {_sentence(assumed, sensor)}"
    return _Description(sensor, Origin(OriginKind.GUESSED, sentence), assumed)


def _sentence(assumed: tuple[Assumable, ...], sensor: Sensor) -> str:
    values = {
        "frame_rate": f"{sensor.frame_rate_hz:g} Hz",
        "flipped": f"rows {'bottom-up' if sensor.flipped else 'top-down'}",
        "bit_order": f"{'least' if sensor.bit_order is BitOrder.LSB else 'most'} significant bit first",
    }
    return f"assumed: {', '.join(values[name] for name in assumed)}" if assumed else "nothing assumed"
