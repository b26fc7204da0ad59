"""Writes the timeline of a reconstruction while it runs: `timeline.jsonl`, which `timeline` reads."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.recon import State, Status, Tracked
from spiked_service.results.timeline import states_at

NAME = "timeline.jsonl"


class TimelineWriter:
    """Starts a timeline; a kill leaves at most one incomplete line. Raises SceneError if the disk is full."""

    def __init__(self, folder: Path, views: int = 0, frames: int = 0, work_s: float = 0.0) -> None:
        """Of the timeline in the folder the first `views` moments stay, gaps before frame `frames`, and progress up to
        `work_s`."""
        path = folder / NAME
        lines = path.read_bytes().splitlines(keepends=True) if views and path.exists() else []
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise _write_error(path, error) from error
        self._frames: list[int] = []
        self._states: list[State] = []
        self._closures: set[tuple[float, float]] = set()
        for line in lines:
            self._keep(line, views, frames, work_s)

    @property
    def moments(self) -> int:
        """Number of moments."""
        return len(self._frames)

    def _keep(self, line: bytes, views: int, frames: int, work_s: float) -> None:
        try:
            found = json.loads(line)
        except ValueError:
            return  # a kill left it incomplete
        if "closure" in found:
            return  # the reconstructor knows its closed loops, and `closed` adds them again
        if "progress" in found:
            if found["progress"]["work_s"] <= work_s:
                self._add(found)
        elif "gap" in found and found["gap"]["first"] < frames:
            self._add(found)
        elif "gap" not in found and len(self._frames) < views:
            self._frames.append(int(found["frame"]))
            self._states.append(State(found["state"]))
            self._add(found)

    def tracked(self, view: Tracked, status: Status, psnr_db: float | None, work_s: float) -> None:
        """Add a line for a tracked view, with the current figures of the map and the seconds of work so far."""
        self._frames.append(int(view.time))
        self._states.append(view.state)
        self._add(
            {
                "time_s": view.time_s,
                "frame": int(view.time),
                "state": view.state,
                "reason": status.reason,
                "chi2": view.chi2,
                "sigma_px": view.sigma_px,
                "rate": view.rate,
                "loss": status.loss,
                "psnr_db": psnr_db,
                "splats": status.splats,
                "work_s": work_s,
            }
        )

    def progress(self, status: Status, psnr_db: float | None, work_s: float) -> None:
        """Add a line for the map after so much work, if there is a map."""
        if status.loss is not None:
            figures = {"work_s": work_s, "loss": status.loss, "psnr_db": psnr_db, "splats": status.splats}
            self._add({"progress": figures})

    def lost(self, first: int, count: int, cause: str) -> None:
        """Add a line for lost frames."""
        self._add({"gap": {"first": first, "count": count, "cause": cause}})

    def closed(self, closures: Sequence[tuple[float, float]]) -> None:
        """Add lines for the closed loops that have none yet: times of the earlier and the later view, in seconds."""
        for earlier_s, later_s in closures:
            if (earlier_s, later_s) not in self._closures:
                self._closures.add((earlier_s, later_s))
                self._add({"closure": {"earlier_s": earlier_s, "later_s": later_s}})

    def states_at(self, frames: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """The tracking state at each of the frames [n]."""
        return states_at(self._frames, self._states, frames)

    def _add(self, line: dict[str, Any]) -> None:
        try:
            self._file.write(json.dumps(line).encode() + b"\n")
            self._file.flush()
        except OSError as error:
            raise _write_error(Path(self._file.name), error) from error


def _write_error(path: Path, error: OSError) -> SceneError:
    return SceneError(f"{path}: the timeline cannot be written: {error.strerror}; free disk space")
