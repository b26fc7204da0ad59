"""Limits on concurrent operations and on requests per second."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from spiked.errors import SpikedError

_CALLERS = 4096
"""Callers whose rate is kept; the least recently active one is dropped first."""


class OverloadedError(SpikedError):
    """A concurrency limit is reached; the caller can try again in a moment."""


class ConcurrencyLimit:
    """Limits how many operations run at a time. Thread-safe."""

    def __init__(self, what: str, limit: int) -> None:
        self._what = what
        self._lock = threading.Lock()
        self.limit = limit
        """May be changed at any time; operations in progress continue."""
        self.active = 0
        """Operations in progress."""
        self.rejected = 0
        """Operations rejected since the start."""

    def acquire(self) -> None:
        """Begin an operation. Raises OverloadedError at the limit."""
        with self._lock:
            if self.active >= self.limit:
                self.rejected += 1
                raise OverloadedError(
                    f"the limit of {self.limit} {self._what} at a time is reached; try again in a moment"
                )
            self.active += 1

    def release(self) -> None:
        """End an operation."""
        with self._lock:
            self.active -= 1

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """One operation as a context. Raises OverloadedError at the limit."""
        self.acquire()
        try:
            yield
        finally:
            self.release()


class RateLimit:
    """A token bucket per caller: `rate` requests a second on average, bursts of `burst`. Thread-safe."""

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate = rate
        self.burst = burst
        self._clock = clock
        self._lock = threading.Lock()
        self._callers: OrderedDict[str, tuple[float, float]] = OrderedDict()

    @property
    def callers(self) -> int:
        """Callers remembered, at most 4096."""
        return len(self._callers)

    def wait_s(self, caller: str) -> float:
        """Count a request and return 0, or return the seconds until the caller may send one."""
        now_s = self._clock()
        with self._lock:
            tokens, then_s = self._callers.get(caller, (float(self.burst), now_s))
            tokens = min(float(self.burst), tokens + (now_s - then_s) * self.rate)
            allowed = tokens >= 1
            self._callers[caller] = (tokens - 1 if allowed else tokens, now_s)
            self._callers.move_to_end(caller)
            if len(self._callers) > _CALLERS:
                self._callers.popitem(last=False)
            return 0.0 if allowed else (1 - tokens) / self.rate
