"""What a tracker goes through, written line by line while it does: `timeline.jsonl`, which `timeline` reads."""

import json
from pathlib import Path
from typing import Any

from spiked.recon import Status, Tracked

NAME = "timeline.jsonl"


class Chronicle:
    """Begins a timeline anew; a kill leaves at most one line unfinished. Raises OSError when the disk is full."""

    def __init__(self, folder: Path) -> None:
        self._file = (folder / NAME).open("w", buffering=1)

    def tracked(self, view: Tracked, status: Status, psnr_db: float | None) -> None:
        """A view was tracked; what the map is like meanwhile goes with it."""
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
        """Frames did not come."""
        self._add({"gap": {"first": first, "count": count, "cause": cause}})

    def _add(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line) + "\n")
