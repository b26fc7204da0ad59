"""The policy of the queue: order, limit, precedence and retries."""

import math
import time
from collections.abc import Sequence

from spiked_service.store.rows import ReconstructionRow, Stage
from spiked_service.workers.backoff import Backoff

_DELAYS_S = (1.0, 5.0)
"""Delays before the retries of a reconstruction whose worker died; after the last retry it has failed."""

REMOTE_DELAYS_S = (1.0, 5.0, 15.0, 30.0, 60.0)
"""The same for other machines, which are switched off and taken away more often than workers die here."""

_NOT_BEGUN_S = 5.0
"""Delay of a job that no machine has begun, because engine, store or service were away."""


class QueuePolicy:
    """Decides which reconstructions run. Not thread-safe; `limit` may be changed at any time.

    The queue is ordered by priority, then by turn, which is the age until a user moves one; held ones stay in it. At
    most `limit` reconstructions run at a time; live ones are not limited but count, so none starts from the queue while
    they reach the limit. When its capture has ended, a live reconstruction refines at once unless others precede it;
    then it is queued.
    """

    MOST_ATTEMPTS = 6
    """Attempts after which a reconstruction that was interrupted by the death of the service has failed."""

    def __init__(self, limit: int = 1, delays_s: tuple[float, ...] = _DELAYS_S) -> None:
        self.limit = limit
        self._delays_s = delays_s
        self._backoffs: dict[str, Backoff] = {}
        self._not_before_s: dict[str, float] = {}

    @property
    def delays(self) -> bool:
        """Whether a queued reconstruction waits for its retry."""
        return bool(self._not_before_s)

    def due(self, reconstruction_id: str) -> bool:
        """Whether the delay before the retry of a queued reconstruction is over."""
        if time.monotonic() < self._not_before_s.get(reconstruction_id, 0.0):
            return False
        self._not_before_s.pop(reconstruction_id, None)
        return True

    def retry(self, reconstruction_id: str) -> bool:
        """Count a death of a worker. Return whether the reconstruction is to be queued again; it is due later.

        Deaths count however long the worker has lived: what kills it after an hour would do so for ever.
        """
        backoff = self._backoffs.setdefault(reconstruction_id, Backoff(self._delays_s, math.inf))
        delay_s = backoff.delay_s()
        if delay_s is None:
            return False
        self._not_before_s[reconstruction_id] = time.monotonic() + delay_s
        return True

    def postpone(self, reconstruction_id: str) -> None:
        """Have a reconstruction that no machine has begun wait a little; that may go on for as long as it takes."""
        self._not_before_s[reconstruction_id] = time.monotonic() + _NOT_BEGUN_S

    def reset_retries(self, reconstruction_id: str) -> None:
        """Forget the deaths that were counted; the reconstruction is due."""
        self._backoffs.pop(reconstruction_id, None)
        self._not_before_s.pop(reconstruction_id, None)

    def must_yield(self, row: ReconstructionRow, others: Sequence[ReconstructionRow], queued: bool) -> bool:
        """Whether a live reconstruction that begins to refine must return to the queue.

        It must if others refine already up to the limit, or if one is `queued` that could run instead. `others` are
        the other running ones.
        """
        if not row.live:
            return False
        refining = [other for other in others if not other.live or other.stage is Stage.REFINING]
        return len(refining) >= self.limit or (queued and len(others) < self.limit)
