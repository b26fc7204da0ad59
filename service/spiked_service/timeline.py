"""How a reconstruction went, line by line as its worker wrote it: `timeline.jsonl`."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from spiked.recon import State


class Moment(BaseModel):
    """One line: how things stood after a frame."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    time_s: float
    """Of the camera, since the start of the capture."""
    frame: int
    state: State
    chi2: float | None = None
    sigma_px: float | None = None
    rate: float | None = None
    """Mean spikes a pixel and frame."""
    loss: float | None = None
    psnr_db: float | None = None
    splats: int | None = None


class Missing(BaseModel):
    """Frames that were lost."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    first: int
    count: int
    cause: str = ""


class _Line(BaseModel):
    gap: Missing


@dataclass(frozen=True)
class Timeline:
    """All lines, in their order."""

    moments: list[Moment] = field(default_factory=list)
    gaps: list[Missing] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> "Timeline":
        """Empty if there is no file yet; a line that a killed worker left unfinished is passed over."""
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

    def states_at(self, frames: NDArray[np.int64]) -> list[State | None]:
        """The state of the tracking at each of these frames [n]; None before the first line."""
        if not self.moments:
            return [None] * len(frames)
        known = np.array([moment.frame for moment in self.moments])
        order = np.argsort(known, kind="stable")
        rows = np.searchsorted(known[order], frames, side="left")
        return [self.moments[order[min(row, len(order) - 1)]].state for row in rows]
