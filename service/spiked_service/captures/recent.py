"""The last captures that have ended since the service started, with their last preview."""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from spiked_service.store.rows import CaptureRow
from spiked_service.workers.messages import PreviewTaken

_RECENT = 32
"""Ended captures whose last preview and counters are kept."""


@dataclass(frozen=True)
class _Ended:
    row: CaptureRow
    picture: PreviewTaken | None


class RecentCaptures:
    """The last `_RECENT` captures that have ended. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ended: OrderedDict[str, _Ended] = OrderedDict()

    def add(self, row: CaptureRow, picture: PreviewTaken | None) -> None:
        """Add or replace a capture; the oldest one is dropped."""
        with self._lock:
            self._ended[row.id] = _Ended(row, picture)
            while len(self._ended) > _RECENT:
                self._ended.popitem(last=False)

    def rows(self) -> Sequence[CaptureRow]:
        """Their rows, oldest first."""
        with self._lock:
            return [one.row for one in self._ended.values()]

    def picture(self, capture_id: str) -> PreviewTaken | None:
        """The last preview of a capture; None if there is none."""
        with self._lock:
            ended = self._ended.get(capture_id)
        return None if ended is None else ended.picture

    def drop_picture(self, capture_id: str) -> None:
        """Forget the preview of a capture. Its counters stay, because metrics must not decrease."""
        with self._lock:
            ended = self._ended.get(capture_id)
            if ended is not None:
                self._ended[capture_id] = replace(ended, picture=None)
