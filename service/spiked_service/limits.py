"""How much of a thing at a time, and how many requests a second."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from spiked.errors import SpikedError

_CALLERS = 4096
"""Callers whose rate is remembered; one that has been quiet longest is forgotten first."""


class OverloadedError(SpikedError):
    """As many as are allowed are at it; ask again in a moment."""


class Gate:
    """Lets so many in at a time. Usable from any thread."""

    def __init__(self, what: str, limit: int) -> None:
        self._what = what
        self._lock = threading.Lock()
        self.limit = limit
        """May be changed at any time; who is in stays in."""
        self.inside = 0
        self.refused = 0
        """How many were turned away since the start."""

    def enter(self) -> None:
        """Raises OverloadedError when full."""
        with self._lock:
            if self.inside >= self.limit:
                self.refused += 1
                raise OverloadedError(
                    f"{self.limit} {self._what} at a time are allowed, and as many there are; ask again in a moment"
                )
            self.inside += 1

    def leave(self) -> None:
        """Make room for another."""
        with self._lock:
            self.inside -= 1

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Be inside for a while. Raises OverloadedError when full."""
        self.enter()
        try:
            yield
        finally:
            self.leave()


class RateLimit:
    """A token bucket for each caller: `rate` requests a second on average, `burst` at once. Usable from any thread."""

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate = rate
        self.burst = burst
        self._clock = clock
        self._lock = threading.Lock()
        self._callers: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, caller: str) -> float:
        """0 if the caller may go on, and then this counts as a request; otherwise the seconds until it may."""
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
