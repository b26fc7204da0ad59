"""What is kept in memory of captures that have ended: the last preview, and the counters for the metrics."""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import TypeVar

from spiked_service.captures.ring_counts import RingCount
from spiked_service.workers.messages import PreviewTaken

_RECENT = 32
"""Ended captures whose last preview is kept, and rings whose counters are: metrics read them at the next scrape."""
_T = TypeVar("_T")


class Recent:
    """The last `_RECENT` pictures and ring counters. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pictures: OrderedDict[str, PreviewTaken] = OrderedDict()
        self._rings: OrderedDict[str, RingCount] = OrderedDict()

    def add(self, capture_id: str, picture: PreviewTaken | None) -> None:
        """Keep the last preview of a capture."""
        if picture is not None:
            self._keep(self._pictures, capture_id, picture)

    def add_ring(self, count: RingCount | None) -> None:
        """Keep the final counters of a ring, if it existed."""
        if count is not None:
            self._keep(self._rings, count.ring_id, count)

    def rings(self) -> Sequence[RingCount]:
        """The counters, oldest first."""
        with self._lock:
            return list(self._rings.values())

    def picture(self, capture_id: str) -> PreviewTaken | None:
        """The last preview of a capture; None if there is none."""
        with self._lock:
            return self._pictures.get(capture_id)

    def drop_picture(self, capture_id: str) -> None:
        """Forget the preview of a capture. The counters stay, because metrics must not decrease."""
        with self._lock:
            self._pictures.pop(capture_id, None)

    def _keep(self, kept: OrderedDict[str, _T], key: str, value: _T) -> None:
        with self._lock:
            kept[key] = value
            while len(kept) > _RECENT:
                kept.popitem(last=False)
