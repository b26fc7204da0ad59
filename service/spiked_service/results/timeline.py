"""Reads the timeline of a reconstruction, `timeline.jsonl`, which `timeline_writer` writes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from spiked.recon import State


class Moment(BaseModel):
    """One line: the state of the reconstruction after a frame."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    time_s: float
    """Camera time since the start of the capture."""
    frame: int
    state: State
    chi2: float | None = None
    sigma_px: float | None = None
    rate: float | None = None
    """Mean spikes per pixel and frame."""
    loss: float | None = None
    psnr_db: float | None = None
    splats: int | None = None


class Missing(BaseModel):
    """A gap of lost frames."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    first: int
    count: int
    cause: str = ""


class _Line(BaseModel):
    gap: Missing


@dataclass(frozen=True)
class Timeline:
    """All lines in order."""

    moments: list[Moment] = field(default_factory=list)
    gaps: list[Missing] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> "Timeline":
        """Read a file; empty if it does not exist. Incomplete lines, which a killed worker leaves, are skipped."""
        timeline = cls()
        try:
            lines = path.read_bytes().splitlines()
        except FileNotFoundError:
            return timeline
        for line in lines:
            try:
                if line.startswith(b'{"gap"'):
                    timeline.gaps.append(_Line.model_validate_json(line).gap)
                else:
                    timeline.moments.append(Moment.model_validate_json(line))
            except ValidationError:
                continue
        return timeline

    def states_at(self, frames: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """The tracking state at each of the frames [n]; empty if unknown."""
        return states_at([moment.frame for moment in self.moments], [moment.state for moment in self.moments], frames)


def states_at(known: Sequence[int], states: Sequence[State], frames: NDArray[np.int64]) -> NDArray[np.bytes_]:
    """The states of the views that contain the frames [n]; `known` are the last frames of the views."""
    if not known:
        return np.zeros(len(frames), "S8")
    order = np.argsort(known, kind="stable")
    rows = np.searchsorted(np.array(known)[order], frames, side="left")
    return np.array(states, "S8")[order[np.minimum(rows, len(order) - 1)]]


def frames_at(times_s: NDArray[np.float64], rate_hz: float) -> NDArray[np.int64]:
    """Indices of the frames whose middles are at `times_s`."""
    return np.asarray(np.round(times_s * rate_hz - 0.5), np.int64)
