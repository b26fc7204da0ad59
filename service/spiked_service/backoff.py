"""When to start again what has died."""

import threading
import time
from collections.abc import Callable

_DELAYS_S = (0.0, 0.25, 1.0, 4.0, 15.0)
"""Before each new start; after the last of them no more."""
_FORGIVEN_S = 120.0
"""What has run so long begins with the first delay again."""


class Backoff:
    """Calls again after growing delays, and gives up in the end."""

    def __init__(self, delays_s: tuple[float, ...] = _DELAYS_S) -> None:
        self._delays_s = delays_s
        self._deaths = 0
        self._last_s = time.monotonic()
        self._timer: threading.Timer | None = None
        self._cancelled = False

    @property
    def deaths(self) -> int:
        """How often in a row it has died."""
        return self._deaths

    def delay_s(self) -> float | None:
        """How long to wait after one more death; None: not again."""
        now_s = time.monotonic()
        if now_s - self._last_s > _FORGIVEN_S:
            self._deaths = 0
        self._last_s = now_s
        self._deaths += 1
        return self._delays_s[self._deaths - 1] if self._deaths <= len(self._delays_s) else None

    def again(self, start: Callable[[], None]) -> float | None:
        """Count a death and call `start` after the delay, which is returned; None: it died too often."""
        delay_s = self.delay_s()
        if delay_s is None or self._cancelled:
            return None
        self._timer = threading.Timer(delay_s, start)
        self._timer.daemon = True
        self._timer.start()
        return delay_s

    def cancel(self) -> None:
        """Start nothing any more."""
        self._cancelled = True
        if self._timer is not None:
            self._timer.cancel()
