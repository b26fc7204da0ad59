"""Writes the timeline of a reconstruction while it runs: `timeline.jsonl`, which `timeline` reads."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.recon import State, Status, Tracked
from spiked_service.results.timeline import states_at

NAME = "timeline.jsonl"


class TimelineWriter:
    """Starts a new timeline; a kill leaves at most one incomplete line. Raises OSError if the disk is full."""

    def __init__(self, folder: Path) -> None:
        self._file = (folder / NAME).open("w", buffering=1)
        self._frames: list[int] = []
        self._states: list[State] = []

    def tracked(self, view: Tracked, status: Status, psnr_db: float | None) -> None:
        """Add a line for a tracked view, with the current figures of the map."""
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
            }
        )

    def lost(self, first: int, count: int, cause: str) -> None:
        """Add a line for lost frames."""
        self._add({"gap": {"first": first, "count": count, "cause": cause}})

    def states_at(self, frames: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """The tracking state at each of the frames [n]."""
        return states_at(self._frames, self._states, frames)

    def _add(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line) + "\n")
