"""Limits guessing of tokens: logs wrong tokens and delays addresses that try many different ones."""

import hashlib
import ipaddress
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from spiked_service.events.logging import logger

_log = logger("spiked.security")
_FREE = 10
"""Different wrong tokens that an address may send without delay; repeats of one count once."""
_LONGEST_S = 60.0
"""Longest delay; it doubles with each wrong token."""
_FORGOTTEN_S = 900.0
"""An address without wrong tokens for this long starts anew."""
_LOG_S = 10.0
"""Least time between log lines of one address; each has the number of wrong tokens since the last."""
_CALLERS = 4096
"""Addresses that are remembered; the least recently active one is dropped first."""
_REMEMBERED = 32
"""Wrong tokens that are remembered per address."""


@dataclass
class _Caller:
    seen_s: float
    guesses: int = 0
    until_s: float = 0.0
    logged_s: float | None = None
    unlogged: int = 0
    wrong: deque[bytes] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    right: set[bytes] = field(default_factory=set)


class WrongTokens:
    """Counts wrong tokens by IPv4 address or IPv6 network (/64). Thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._callers: OrderedDict[str, _Caller] = OrderedDict()

    @property
    def callers(self) -> int:
        """Networks remembered, at most 4096."""
        return len(self._callers)

    def wait_s(self, address: str, token: str, right: bool) -> float:
        """Record a token; return 0 if the request may be answered, else the seconds until one may.

        While an address is delayed, new tokens are rejected whether right or not. Tokens that were right from this
        address before keep working, so that other users behind the same address are not locked out.
        """
        now_s, digest = self._clock(), hashlib.sha256(token.encode(errors="surrogatepass")).digest()
        with self._lock:
            caller = self._caller(_network(address), now_s)
            new = digest not in caller.right and digest not in caller.wrong
            wait_s = max(0.0, caller.until_s - now_s) if new else 0.0
            if not wait_s and right:
                caller.right.add(digest)
            elif not wait_s and new:
                caller.wrong.append(digest)
                caller.guesses += 1
                if caller.guesses > _FREE:
                    caller.until_s = now_s + min(_LONGEST_S, 2.0 ** (caller.guesses - _FREE - 1))
            count = 0 if right and not wait_s else self._log_count(caller, now_s)
        if count:
            _log.warning("wrong token", address=address, count=count, wait_s=round(wait_s, 1))
        return wait_s

    def _caller(self, network: str, now_s: float) -> _Caller:
        caller = self._callers.setdefault(network, _Caller(now_s))
        if now_s - caller.seen_s > _FORGOTTEN_S:
            caller.guesses = 0
        caller.seen_s = now_s
        self._callers.move_to_end(network)
        if len(self._callers) > _CALLERS:
            self._callers.popitem(last=False)
        return caller

    def _log_count(self, caller: _Caller, now_s: float) -> int:
        """Number of wrong tokens for a log line; 0: no line now."""
        caller.unlogged += 1
        if caller.logged_s is not None and now_s - caller.logged_s < _LOG_S:
            return 0
        caller.logged_s, count, caller.unlogged = now_s, caller.unlogged, 0
        return count


def _network(address: str) -> str:
    try:
        known = ipaddress.ip_address(address)
    except ValueError:
        return address
    return address if known.version == 4 else str(ipaddress.ip_network((known, 64), strict=False))
