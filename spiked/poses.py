"""Poses on disk: an append-only binary file, read in ranges through a memory map.

A header of 128 bytes, little-endian: the magic `SPKPOSES`, version (u32), bytes of the header (u32), bytes of a record
(u32), a zero (u32), and the layout of a record as text, filled up with zeros. Then records, ordered by time. An
incomplete record at the end of the file, left by a crash, is ignored.
"""

import os
import struct
from bisect import bisect_left
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.pose import Array, quaternion, rotation_of
from spiked.trajectory import Trajectory, tum_tables

__all__ = ["PoseAppender", "PoseFile", "UnorderedError", "convert_tum"]

_MAGIC = b"SPKPOSES"
_VERSION = 1
"""Of the format."""
_HEADER_BYTES = 128
"""Length of the header."""
_LAYOUT = b"time_s f8, position 3f8, quaternion_wxyz 4f8, state S8"
_RECORD = np.dtype([("time_s", "<f8"), ("position", "<f8", 3), ("quaternion_wxyz", "<f8", 4), ("state", "S8")])
_HEADER = (_MAGIC + struct.pack("<4I", _VERSION, _HEADER_BYTES, _RECORD.itemsize, 0) + _LAYOUT).ljust(
    _HEADER_BYTES, b"\0"
)
_CHUNK = 65_536
"""Records read or written at a time."""
_TIME_DECIMALS = 9
"""Times are kept to the nanosecond, as in the text formats: a time that was read selects the same pose again."""

Records = NDArray[Any]
"""Structured array [n]: time_s (seconds), position [3], quaternion_wxyz [4], camera to world; state: ASCII."""

StatesAt = Callable[[Array], NDArray[np.bytes_]]


class UnorderedError(SceneError):
    """Poses that are earlier than those before them."""


class PoseFile:
    """A memory-mapped pose file: only requested rows are read. Thread-safe."""

    def __init__(self, path: Path) -> None:
        """Raises SceneError if the file is not a pose file."""
        self.path = path
        try:
            with path.open("rb") as file:
                header = file.read(_HEADER_BYTES)
                count = (os.fstat(file.fileno()).st_size - _HEADER_BYTES) // _RECORD.itemsize
                _check(header, path)
                # A map of no bytes is refused by the system.
                self._records: Records = (
                    np.memmap(file, _RECORD, "r", _HEADER_BYTES, (count,)) if count else np.empty(0, _RECORD)
                )
        except OSError as error:
            raise SceneError(f"cannot read the poses in {path}: {error.strerror}") from error

    def __len__(self) -> int:
        return len(self._records)

    def time_s(self, row: int) -> float:
        """Time of a pose; rows count from the end where they are negative."""
        return float(self._records[row]["time_s"])

    def between(self, begin_s: float, end_s: float) -> range:
        """The rows with begin_s <= time < end_s. Reads O(log n) records."""
        return range(self.first_from(begin_s), self.first_from(end_s))

    def nearest(self, time_s: float, within_s: float) -> int | None:
        """The row nearest to a time, None if none lies within `within_s`. Reads O(log n) records."""
        after = self.first_from(time_s)
        near = [row for row in (after - 1, after) if 0 <= row < len(self)]
        row = min(near, key=lambda row: abs(self.time_s(row) - time_s), default=None)
        return row if row is not None and abs(self.time_s(row) - time_s) <= within_s else None

    def records(self, rows: range) -> Records:
        """A copy of the records [n] of these rows; the rows are in ascending order."""
        return np.array(self._records[rows.start : rows.stop : rows.step])

    def trajectory(self, rows: range) -> Trajectory:
        """The poses of these rows."""
        found = self.records(rows)
        return Trajectory(found["time_s"], rotation_of(found["quaternion_wxyz"]), found["position"])

    def first_from(self, time_s: float) -> int:
        """The first row that is not earlier. Reads O(log n) records."""
        return bisect_left(range(len(self)), time_s, key=self.time_s)


class PoseAppender:
    """Appends to a new or existing pose file, from one process at a time. Raises OSError if writing fails."""

    def __init__(self, path: Path) -> None:
        """An incomplete header or record is overwritten. Raises SceneError if the file is not a pose file."""
        self._path = path
        self._file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+b")
        header = self._file.read(_HEADER_BYTES)
        if _HEADER.startswith(header):
            self._file.seek(0)
            self._file.write(_HEADER)
        else:
            _check(header, path)
        self._count = max(0, self._file.seek(0, os.SEEK_END) - _HEADER_BYTES) // _RECORD.itemsize
        self._file.truncate(self._file.seek(_HEADER_BYTES + self._count * _RECORD.itemsize))
        self._file.flush()
        self._last_s = PoseFile(path).time_s(-1) if self._count else -np.inf

    def append(self, poses: Trajectory, states: NDArray[np.bytes_] | None = None) -> None:
        """Append poses, not earlier than the last one, with the tracking state of each (ASCII [n])."""
        for first in range(0, len(poses), _CHUNK):
            part = slice(first, first + _CHUNK)
            self._append(
                poses.times_s[part],
                poses.centres[part],
                quaternion(poses.rotations[part]),
                None if states is None else states[part],
            )

    def append_table(self, table: Array, states: NDArray[np.bytes_] | None = None) -> None:
        """Rows [n, 8] as in a TUM file, of `Trajectory.table`, and the states at each."""
        norm = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
        self._append(table[:, 0], table[:, 1:4], (table[:, 4:] / norm)[:, [3, 0, 1, 2]], states)

    def sync(self) -> None:
        """Write everything to the disk (fsync)."""
        self._file.flush()
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Flush appended poses to the kernel."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _append(self, times_s: Array, centres: Array, wxyz: Array, states: NDArray[np.bytes_] | None) -> None:
        records = np.zeros(len(times_s), _RECORD)
        records["time_s"] = np.round(times_s, _TIME_DECIMALS)
        if len(records) and (records["time_s"][0] < self._last_s or np.any(np.diff(records["time_s"]) < 0)):
            raise UnorderedError(f"poses for {self._path} are not in the order of their times; sort them first")
        records["position"], records["quaternion_wxyz"] = centres, wxyz
        if states is not None:
            records["state"] = states
        self._file.write(records.tobytes())
        self._file.flush()
        self._last_s = float(records["time_s"][-1]) if len(records) else self._last_s


def convert_tum(tum: Path, poses: Path, states: StatesAt | None = None) -> None:
    """Convert a TUM file to a pose file, atomically for readers; `states` maps times [n] to tracking states [n].

    Raises SceneError, OSError.
    """
    part = poses.with_name(poses.name + ".part")
    try:
        try:
            _convert(tum_tables(tum), part, states)
        except UnorderedError:
            _convert([Trajectory.read_tum(tum).table()], part, states)
        part.replace(poses)
    finally:
        part.unlink(missing_ok=True)


def _convert(tables: Iterable[Array], part: Path, states: StatesAt | None) -> None:
    part.unlink(missing_ok=True)
    with PoseAppender(part) as out:
        for table in tables:
            out.append_table(table, None if states is None else states(table[:, 0]))
        out.sync()


def _check(header: bytes, path: Path) -> None:
    if not header.startswith(_MAGIC):
        raise SceneError(f"{path} is not a file of poses: it does not begin with {_MAGIC.decode()}")
    if header != _HEADER:
        raise SceneError(f"{path} holds poses in a layout that this version cannot read; export them with another")
