"""Reads the timeline of a reconstruction, `timeline.jsonl`, which `timeline_writer` writes."""

import math
import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from spiked.recon import State

_KEPT = 4
"""Timelines in memory, each some 2 MB a minute of recording; of these only new lines are read."""
_TAIL_BYTES = 256
"""Before the place to which a file was read: if they have changed, it is another timeline."""
STATES = (State.LOST, State.RELOC, State.DEGRADED, State.BOOT, State.TRACK)
"""The state of several moments is the first of these among them: a short loss shows at any scale."""
_MEANS = ("chi2", "sigma_px", "rate", "loss")
_MOMENT = np.dtype(
    [
        ("time_s", "f8"),
        ("frame", "i8"),
        ("state", "u1"),
        *((name, "f8") for name in _MEANS),
        ("psnr_db", "f8"),
        ("splats", "f8"),
        ("work_s", "f8"),
    ]
)

Moments = NDArray[Any]
"""Structured array [n]: camera time in seconds since the start of the capture, frame, index into `STATES`, fit of the
pose, mean spikes per pixel and frame, figures of the map, and seconds of work; NaN where a value is not known."""


class Missing(BaseModel):
    """A gap of lost frames."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    first: int
    count: int
    cause: str = ""


class Closure(BaseModel):
    """A closed loop: the camera sees at the later time what it saw at the earlier one."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    earlier_s: float
    later_s: float


class Progress(BaseModel):
    """The map after so much work, also after the last frame."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    work_s: float
    loss: float
    psnr_db: float | None = None
    splats: int


class _Line(BaseModel):
    gap: Missing | None = None
    closure: Closure | None = None
    progress: Progress | None = None


@dataclass
class Timeline:
    """All lines in order."""

    moments: Moments = field(default_factory=lambda: np.zeros(0, _MOMENT))
    gaps: list[Missing] = field(default_factory=list)
    closures: list[Closure] = field(default_factory=list)
    progress: list[Progress] = field(default_factory=list)
    """Over the seconds of work."""

    @classmethod
    def read(cls, path: Path) -> "Timeline":
        """Read a file; empty if it does not exist. Incomplete lines, which a killed worker leaves, are skipped."""
        timeline = cls()
        with suppress(FileNotFoundError):
            timeline.add(path.read_bytes())
        return timeline

    def add(self, lines: bytes) -> None:
        """Add lines of a file."""
        rows = []
        for line in lines.splitlines():
            try:
                if line.startswith((b'{"gap"', b'{"closure"', b'{"progress"')):
                    other = _Line.model_validate_json(line)
                    self.gaps += [other.gap] if other.gap else []
                    self.closures += [other.closure] if other.closure else []
                    self.progress += [other.progress] if other.progress else []
                else:
                    rows.append(_moment(orjson.loads(line)))
            except (ValidationError, ValueError, KeyError, TypeError):
                continue
        if rows:
            self.moments = np.concatenate([self.moments, np.array(rows, _MOMENT)])

    def between(self, from_s: float | None, to_s: float | None) -> "Timeline":
        """What lies in from_s <= time < to_s, with all closures and all progress."""
        begin, end = -np.inf if from_s is None else from_s, np.inf if to_s is None else to_s
        times = self.moments["time_s"]
        gaps = self.gaps
        if len(times) and times[-1] > 0:
            rate_hz = self.moments["frame"][-1] / times[-1]
            gaps = [one for one in gaps if one.first < end * rate_hz and one.first + one.count > begin * rate_hz]
        return Timeline(self.moments[(times >= begin) & (times < end)], gaps, self.closures, self.progress)

    def reduced(self, points: int) -> "Timeline":
        """At most `points` moments: the worst state, means, and the last frame and counts of so many neighbours.

        Gaps close to each other are joined, to at most `points` too: their count is that of all.
        """
        moments = self.moments
        size = -(-len(moments) // points)
        if size > 1:
            starts = np.arange(0, len(moments), size)
            last = moments[np.minimum(starts + size, len(moments)) - 1].copy()
            last["state"] = np.minimum.reduceat(moments["state"], starts)
            for name in _MEANS:
                known = np.isfinite(moments[name])
                count = np.add.reduceat(known, starts, dtype=np.int64)
                total = np.add.reduceat(np.where(known, moments[name], 0), starts, dtype=np.float64)
                last[name] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
            moments = last
        return Timeline(moments, _joined(self.gaps, points), self.closures, _some(self.progress, points))

    def states_at(self, frames: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """The tracking state at each of the frames [n]; empty if unknown."""
        return states_at(self.moments["frame"], [STATES[one] for one in self.moments["state"]], frames)


class Timelines:
    """Timelines that grow while they are asked for: what was read once is not read again. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[Path, tuple[int, bytes, Timeline]] = OrderedDict()

    def read(self, path: Path) -> Timeline:
        """As `Timeline.read`."""
        with self._lock:
            end, tail, timeline = self._known.pop(path, (0, b"", Timeline()))
            try:
                with path.open("rb") as file:
                    file.seek(end - len(tail))
                    if file.read(len(tail)) != tail:
                        end, tail, timeline = 0, b"", Timeline()
                        file.seek(0)
                    lines = file.read()
            except FileNotFoundError:
                return Timeline()
            whole = lines[: lines.rfind(b"\n") + 1]
            timeline.add(whole)
            self._known[path] = end + len(whole), (tail + whole)[-_TAIL_BYTES:], timeline
            if len(self._known) > _KEPT:
                self._known.popitem(last=False)
            return Timeline(timeline.moments, list(timeline.gaps), list(timeline.closures), list(timeline.progress))


def known(values: Iterable[float]) -> list[float | None]:
    """Numbers as they are shown: None for NaN."""
    return [None if math.isnan(value) else value for value in values]


def _moment(line: dict[str, Any]) -> tuple[float | int, ...]:
    state = STATES.index(State(line["state"]))
    others = (line.get(name) for name in (*_MEANS, "psnr_db", "splats", "work_s"))
    return float(line["time_s"]), int(line["frame"]), state, *(np.nan if one is None else float(one) for one in others)


def _some(progress: Sequence[Progress], most: int) -> list[Progress]:
    """At most so many, the last one among them."""
    step = max(1, -(-len(progress) // most))
    return list(progress[::-1][::step][::-1])


def _joined(gaps: Sequence[Missing], most: int) -> list[Missing]:
    if len(gaps) <= most:
        return list(gaps)
    first, end = gaps[0].first, gaps[-1].first + 1
    joined: dict[int, Missing] = {}
    for gap in gaps:
        place = (gap.first - first) * most // (end - first)
        other = joined.get(place)
        if other is None:
            joined[place] = gap
        else:
            cause = other.cause if other.cause == gap.cause else "several causes"
            joined[place] = Missing(first=other.first, count=other.count + gap.count, cause=cause)
    return list(joined.values())


def states_at(
    known: Sequence[int] | NDArray[np.int64], states: Sequence[State], frames: NDArray[np.int64]
) -> NDArray[np.bytes_]:
    """The states of the views that contain the frames [n]; `known` are the last frames of the views."""
    if not len(known):
        return np.zeros(len(frames), "S8")
    order = np.argsort(known, kind="stable")
    rows = np.searchsorted(np.array(known)[order], frames, side="left")
    return np.array(states, "S8")[order[np.minimum(rows, len(order) - 1)]]


def frames_at(times_s: NDArray[np.float64], rate_hz: float) -> NDArray[np.int64]:
    """Indices of the frames whose middles are at `times_s`."""
    return np.asarray(np.round(times_s * rate_hz - 0.5), np.int64)
