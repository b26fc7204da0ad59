"""Checkpoints of a reconstruction from a recording: after a kill it goes on, and ends with the same result.

The state is the reconstructor itself, pickled; what would grow with the recording is not written again and again.
Frames are read from the recording, and images of views are built from them. Tracks of a view and images of keyframes
are written once. So is all of the tracking, once it has ended. Only classes of spiked and the few of numpy that arrays
need are read back, after a digest was checked (docs/decisions/0017-checkpoints.md).
"""

import hashlib
import io
import pickle
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import spiked
from spiked.errors import CheckpointError, SpikedError
from spiked.recon.checkpoint_file import CheckpointFolder, Place, State, read
from spiked.recon.environment import versions
from spiked.recon.frontend.recorded_views import RecordedFrames
from spiked.recon.reconstructor import Reconstructor
from spiked.recording import Recording

__all__ = ["CheckpointSaver", "Interrupted"]

PERIOD_S, LONGEST_PERIOD_S = 3.0, 6.0
"""Seconds from one checkpoint to the next, at least and at most: with the time of the longest step, and of writing, a
kill loses less than 10 s of work."""
COST_SHARE = 0.015
"""Share of the time that checkpoints may take before they become rarer."""
SAMPLED_BYTES, SAMPLES = 65_536, 32
"""Size and number of the pieces of a recording, evenly spread, that tell it from others."""
LOOSE_RATIO, LOOSE_BYTES = 2, 64 << 20
"""The file of arrays is written anew when it is larger than this many times what the state needs of it, and this."""
_SHARED = "odometry", "views", "windows"
"""Names of `Reconstructor.tracking_parts`."""
_PACKAGES = ("recon", "render", "native")
"""Packages whose code decides whether a state fits, with the modules of `spiked` itself."""
_MODULES = tuple(
    f"spiked.{name}"
    for name in ("recon.", "render.", "calibration", "distortion", "pose", "scene", "sensor", "spline", "trajectory")
)
"""Beginnings of the names of modules whose classes a state may contain."""
_ALLOWED = {
    ("builtins", "set"),
    ("builtins", "slice"),
    ("collections", "deque"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.random._pickle", "__bit_generator_ctor"),
    ("numpy.random._pickle", "__generator_ctor"),
    ("numpy.random._pcg64", "PCG64"),
    ("numpy.random.bit_generator", "SeedSequence"),
    ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"),
}
"""Names outside of spiked that a state may contain."""


@dataclass(frozen=True)
class Interrupted:
    """A checkpoint that was read and is whole."""

    folder: Path
    state: State

    @classmethod
    def read(cls, folder: Path) -> "Interrupted":
        """Raises CheckpointError if there is none, or if it is damaged or of another format."""
        return cls(folder, read(folder))

    @property
    def parameters(self) -> dict[str, Any]:
        """What the run was begun with, as it was given to `CheckpointSaver`."""
        return dict(self.state.header["parameters"])

    @property
    def recording(self) -> Path:
        """Where the recording was."""
        return Path(self.state.header["recording"]["path"])

    @property
    def stage(self) -> str:
        """How far it was, for users."""
        header = self.state.header
        share = f" at {header['progress']:.0%}" if header["progress"] and header["stage"] != "done" else ""
        return f"{header['stage']}{share}, {header['frames']} frames, {header['work_s']:.0f} s of work"

    def resume(self, recording: Recording) -> Reconstructor:
        """The reconstructor as it was, on the same recording. Raises CheckpointError."""
        header = self.state.header
        if header["program"] != _program():
            there = header["program"]
            raise CheckpointError(
                f"{self.folder}: it was written by another build of spiked ({there['spiked']}, Python "
                f"{there['python']}, numpy {there['numpy']}): begin anew, or go on with that build"
            )
        found, stored = _identity(recording), header["recording"]
        if different := [name for name in stored if name != "path" and stored[name] != found.get(name)]:
            raise CheckpointError(
                f"{self.folder}: it belongs to another recording than {recording.path}: they differ in "
                f"{', '.join(different)}"
            )
        try:
            tracking, rest = self._parts()
            shared = _Unpickler(tracking, self.state, recording, {}).load()
            reconstructor = _Unpickler(rest, self.state, recording, dict(zip(_SHARED, shared, strict=True))).load()
        except SpikedError:
            raise
        except Exception as error:  # whatever a pickle raises: its digest is right, so another program wrote it
            raise CheckpointError(f"{self.folder}: its state cannot be read ({error}): begin anew") from error
        if not isinstance(reconstructor, Reconstructor):
            raise CheckpointError(f"{self.folder}: its state is not that of a reconstruction: begin anew")
        return reconstructor

    def _parts(self) -> tuple[bytes, bytes]:
        place, payload = self.state.header["tracking"], self.state.payload
        if isinstance(place, int):
            return payload[:place], payload[place:]
        return self.state.array(Place(place[0], place[1], tuple(place[2]))).tobytes(), payload


class CheckpointSaver:
    """Saves checkpoints of one reconstructor, a few seconds of work apart; a thread writes them.

    Where a checkpoint cannot be written the run goes on; `warn` is told once.
    """

    def __init__(
        self,
        folder: Path,
        recording: Recording,
        parameters: Mapping[str, Any],
        warn: Callable[[str], None],
    ) -> None:
        """`parameters`, ready for JSON, are what the run was begun with.

        Raises CheckpointError if another process writes there. Files are made by the first checkpoint; one that is
        there stays until then.
        """
        self._recording, self._parameters = recording, dict(parameters)
        self._warn: Callable[[str], None] | None = warn
        self._folder = CheckpointFolder(folder)
        self._header: dict[str, Any] | None = None
        self._placed: dict[int, tuple[NDArray[Any], Place]] = {}
        """Arrays of the newest checkpoint that are written once, by `id`."""
        self._tracking: NDArray[np.uint8] | None = None
        """The pickled part of the tracking after its end."""
        self._writing: threading.Thread | None = None
        self._error: OSError | None = None
        self._begun_s = time.monotonic()
        self._cost_s = 0.0
        self.spent_s = 0.0
        """CPU seconds of all checkpoints."""
        self.saved = 0
        """Number of checkpoints."""
        if folder.exists():
            self._folder.lock()

    @property
    def due(self) -> bool:
        """Whether enough was done since the last checkpoint, and that one is written."""
        period_s = min(max(PERIOD_S, self._cost_s / COST_SHARE), LONGEST_PERIOD_S)
        return time.monotonic() - self._begun_s >= period_s and not self._is_writing

    @property
    def _is_writing(self) -> bool:
        return self._writing is not None and self._writing.is_alive()

    def save(self, reconstructor: Reconstructor, now: bool = False) -> None:
        """Save a checkpoint if it is due; with `now` at once, and return when it is on the disk.

        Call it between two calls of the reconstructor, or where `finish` calls its `save`.
        """
        if not (now or self.due):
            return
        self._join()
        begun_s, self._begun_s = time.thread_time(), time.monotonic()
        header, payload, arrays, placed = self._pickled(reconstructor)
        self._cost_s = time.thread_time() - begun_s
        self._writing = threading.Thread(
            target=self._write, args=(header, payload, arrays, placed), name="checkpoint", daemon=False
        )
        self._writing.start()
        if now:
            self._join()

    def remove(self) -> None:
        """The run is complete: delete the checkpoint."""
        self._join()
        try:
            self._folder.remove()
        except OSError as error:
            self._tell(error)

    def close(self) -> None:
        """Wait for the last checkpoint, and keep it."""
        self._join()
        self._folder.close()

    def _join(self) -> None:
        if self._writing is not None:
            self._writing.join()
            self._writing = None
        if self._error is not None:
            self._tell(self._error)
            self._error = None

    def _tell(self, error: OSError) -> None:
        if self._warn is not None:
            self._warn(
                f"{self._folder.path}: no checkpoint can be written: {error.strerror}; the work goes on, but after a "
                "kill it goes on from the last checkpoint, or begins anew"
            )
            self._warn = None

    def _write(
        self,
        header: dict[str, Any],
        payload: bytes,
        arrays: list[NDArray[Any]],
        placed: dict[int, tuple[NDArray[Any], Place]],
    ) -> None:
        begun_s = time.thread_time()
        try:
            self._folder.write(header, payload, arrays)
            self._placed = placed
            self.saved += 1
        except OSError as error:
            self._error, self._tracking = error, None  # it refers to arrays that were to be written
        self._cost_s += time.thread_time() - begun_s
        self.spent_s += self._cost_s

    def _pickled(
        self, reconstructor: Reconstructor
    ) -> tuple[dict[str, Any], bytes, list[NDArray[Any]], dict[int, tuple[NDArray[Any], Place]]]:
        """Header, payload, the arrays to append, and all arrays with their places."""
        used = sum(place.end - place.begin for _, place in self._placed.values())
        if self._folder.arrays_bytes > max(LOOSE_RATIO * used, LOOSE_BYTES):
            self._folder.begin_arrays()
            self._placed, self._tracking = {}, None
        once = _Once(self._placed, self._folder.arrays_bytes)
        if self._tracking is None or not reconstructor.tracking_ended:
            once.allow(reconstructor.odometry.fixed_arrays())
            tracking = _pickle(reconstructor.tracking_parts, once, {}, reconstructor, self._recording)
            if reconstructor.tracking_ended:
                self._tracking = np.frombuffer(tracking, np.uint8)
        else:
            once.keep()
        place: object
        if self._tracking is None:
            place = len(tracking)
        else:
            at = once.place(self._tracking)
            tracking, place = b"", (at.begin, at.dtype, at.shape)
        names = {id(part): name for part, name in zip(reconstructor.tracking_parts, _SHARED, strict=True)}
        rest = _pickle(reconstructor, once, names, reconstructor, self._recording)
        status = reconstructor.status()
        header = self._fixed_header() | {
            "tracking": place,
            "stage": status.stage,
            "frames": status.frames,
            "progress": status.progress,
            "work_s": reconstructor.work_s,
        }
        return header, tracking + rest, once.new, once.placed

    def _fixed_header(self) -> dict[str, Any]:
        if self._header is None:
            self._header = {
                "program": _program(),
                "recording": _identity(self._recording),
                "parameters": self._parameters,
            }
        return self._header


class _Once:
    """Arrays that are written once: those before, and new ones."""

    def __init__(self, before: dict[int, tuple[NDArray[Any], Place]], end: int) -> None:
        self._before, self._end = before, end
        self._allowed: set[int] = set()
        self.placed: dict[int, tuple[NDArray[Any], Place]] = {}
        self.new: list[NDArray[Any]] = []

    def allow(self, arrays: Any) -> None:
        """These may be written once."""
        self._allowed.update(id(array) for array in arrays)

    def keep(self) -> None:
        """All arrays before are still needed."""
        self.placed.update(self._before)

    def is_one(self, array: NDArray[Any]) -> bool:
        """Whether an array is written once."""
        return id(array) in self._allowed

    def place(self, array: NDArray[Any]) -> Place:
        """Where an array lies; it must not change from now on."""
        found = self.placed.get(id(array)) or self._before.get(id(array))
        if found is None:
            array.flags.writeable = False
            found = array, Place(self._end, array.dtype.str, array.shape)
            self._end = found[1].end
            self.new.append(array)
        self.placed[id(array)] = found
        return found[1]


def _pickle(
    root: object, once: _Once, shared: dict[int, str], reconstructor: Reconstructor, recording: RecordedFrames
) -> bytes:
    out = io.BytesIO()
    _Pickler(out, once, shared, reconstructor, recording).dump(root)
    return out.getvalue()


class _Pickler(pickle.Pickler):
    def __init__(
        self,
        out: io.BytesIO,
        once: _Once,
        shared: dict[int, str],
        reconstructor: Reconstructor,
        recording: RecordedFrames,
    ) -> None:
        super().__init__(out, protocol=5)
        self._once, self._shared, self._recording = once, shared, recording
        self._first, self._waiting = reconstructor.waiting_frames

    def persistent_id(self, obj: Any) -> tuple[Any, ...] | None:
        """What is not pickled: see `_Unpickler.persistent_load`."""
        kind = type(obj)
        if kind is np.ndarray:
            if self._once.is_one(obj):
                place = self._once.place(obj)
                return "array", place.begin, place.dtype, place.shape
            if obj is self._waiting and len(obj):
                return "frames", self._first, len(obj)
            return None
        if obj is self._recording:
            return ("recording",)
        name = self._shared.get(id(obj))
        return None if name is None else ("shared", name)


class _Unpickler(pickle.Unpickler):
    def __init__(self, content: bytes, state: State, frames: RecordedFrames, shared: Mapping[str, object]) -> None:
        super().__init__(io.BytesIO(content))
        self._state, self._recorded, self._shared = state, frames, shared

    def find_class(self, module: str, name: str) -> Any:
        """Classes of spiked and `_ALLOWED`, no functions. Raises CheckpointError for others."""
        if (module, name) in _ALLOWED:
            return super().find_class(module, name)
        if module.startswith(_MODULES):
            found = super().find_class(module, name)
            if isinstance(found, type):
                return found
        raise CheckpointError(f"the checkpoint contains {module}.{name}, which is no state of a reconstruction")

    def persistent_load(self, pid: Any) -> Any:
        """Arrays that were written once, the recording and frames of it, and parts that are shared."""
        match pid:
            case ("array", begin, dtype, shape):
                return self._state.array(Place(begin, dtype, shape))
            case ("frames", first, count):
                return self._frames(first, count)
            case ("recording",):
                return self._recorded
            case ("shared", name):
                return self._shared[name]
        raise CheckpointError(f"the checkpoint refers to {pid!r}, which this program does not know")

    def _frames(self, first: int, count: int) -> NDArray[np.uint8]:
        found = self._recorded.captured(first, count)
        if found is None:
            raise CheckpointError(f"frames {first} to {first + count - 1} are not in the recording any more")
        return found


@cache
def _program() -> dict[str, str]:
    """What has to be the same for a state to fit."""
    digest = hashlib.blake2b(digest_size=16)
    home = Path(spiked.__file__).parent
    folders = [home.glob("*.py"), *((home / name).rglob("*") for name in _PACKAGES)]
    for path in sorted(path for found in folders for path in found if path.suffix in (".py", ".so")):
        digest.update(path.relative_to(home).as_posix().encode())
        digest.update(path.read_bytes())
    return versions() | {"build": digest.hexdigest()}


def _identity(recording: Recording) -> dict[str, Any]:
    """What tells a recording from others, ready for JSON."""
    count = max(1, SAMPLED_BYTES // recording.sensor.frame_bytes)
    digest = hashlib.blake2b(digest_size=16)
    for first in np.unique(np.linspace(0, max(0, recording.frames - count), SAMPLES).astype(int)).tolist():
        digest.update(recording.read(first, min(count, recording.frames - first)).tobytes())
    sensor = recording.sensor
    return {
        "path": str(recording.path.absolute()),
        "frames": recording.frames,
        "size": [sensor.width, sensor.height],
        "layout": [str(sensor.layout), str(sensor.bit_order), sensor.flipped, str(sensor.mosaic)],
        "frame rate": sensor.frame_rate_hz,
        "gaps": [[gap.first, gap.count] for gap in recording.gaps],
        "content": digest.hexdigest(),
    }
