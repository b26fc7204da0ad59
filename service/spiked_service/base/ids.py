"""Identifiers that sort by creation time."""

import re
import secrets
import threading
import time
import uuid
from datetime import UTC, datetime

_PATTERN = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-7[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}")


class _Clock:
    """Milliseconds since 1970 and 4096ths of them, never the same twice."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def tick(self) -> int:
        now_ns = time.time_ns()
        ticks = now_ns // 1_000_000 << 12 | now_ns % 1_000_000 * 4096 // 1_000_000
        with self._lock:
            self._last = max(ticks, self._last + 1)
            return self._last


_clock = _Clock()


def new_id() -> str:
    """A UUID version 7 (RFC 9562, 5.7): 48 bits of milliseconds since 1970, 12 bits of their fraction, 62 random bits.

    Ids of one process also sort within a millisecond, and when the clock is set back.
    """
    ticks = _clock.tick()
    value = (ticks >> 12) << 80 | 0x7 << 76 | (ticks & 0xFFF) << 64 | 0x2 << 62 | secrets.randbits(62)
    return str(uuid.UUID(int=value))


def made_at(one: str) -> datetime:
    """Creation time of an id."""
    return datetime.fromtimestamp((uuid.UUID(one).int >> 80) / 1000, UTC)


def is_id(text: str) -> bool:
    """Whether the text has the format of `new_id`."""
    return _PATTERN.fullmatch(text) is not None
