"""Exponential delays before a failed process is restarted."""

import time

DELAYS_S = (0.0, 0.25, 1.0, 4.0, 15.0)
"""Delay before each restart; after the last one there is no further restart."""
RESET_S = 120.0
"""A process that ran this long starts with the first delay again."""


class Backoff:
    """Counts the failures of one process; each has a longer delay, and after the last there is none."""

    def __init__(self, delays_s: tuple[float, ...] = DELAYS_S, reset_s: float = RESET_S) -> None:
        self._delays_s = delays_s
        self._reset_s = reset_s
        self._failures = 0
        self._last_s = time.monotonic()

    def delay_s(self) -> float | None:
        """Count a failure and return the delay before the next start, None after the last."""
        now_s = time.monotonic()
        if now_s - self._last_s > self._reset_s:
            self._failures = 0
        self._last_s = now_s
        self._failures += 1
        return self._delays_s[self._failures - 1] if self._failures <= len(self._delays_s) else None
