"""Notifies systemd with the protocol of sd_notify(3): datagrams to the socket in $NOTIFY_SOCKET."""

import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from spiked.errors import ConfigurationError


class SystemdNotifier:
    """Sends READY, RELOADING, STOPPING and, while the service is alive, WATCHDOG. Does nothing without systemd."""

    def __init__(self) -> None:
        """Raises ConfigurationError if NOTIFY_SOCKET is not an address."""
        self._address = _address(os.environ.get("NOTIFY_SOCKET", ""))
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def ready(self, status: str) -> None:
        """The service is ready, after the start or a reload."""
        self._notify(f"READY=1\nSTATUS={status}")

    def reloading(self) -> None:
        """Settings are being read; `ready` ends it."""
        self._notify(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """The service is stopping."""
        self._over.set()
        self._notify("STOPPING=1")

    def watch(self, lives: Callable[[], bool]) -> None:
        """Start to answer the watchdog, if there is one, while `lives` returns true.

        `lives` may take at most a quarter of the watchdog's time.
        """
        period_s = _watchdog_s() / 4
        if self._address and period_s:
            self._thread = threading.Thread(target=self._answer, args=(lives, period_s), name="watchdog", daemon=True)
            self._thread.start()

    def _answer(self, lives: Callable[[], bool], period_s: float) -> None:
        while True:
            if lives():
                self._notify("WATCHDOG=1")
            if self._over.wait(period_s):
                return

    def _notify(self, text: str) -> None:
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as connection:
            connection.sendto(text.encode(), self._address)


def _address(text: str) -> str:
    """`@` stands for the zero byte of an abstract address."""
    if text and text[0] not in "/@":
        raise ConfigurationError(f"NOTIFY_SOCKET={text} is not the address of a Unix socket: unset it")
    return f"\0{text[1:]}" if text.startswith("@") else text


def _watchdog_s() -> float:
    """Watchdog time for this process, 0 if there is none. See sd_watchdog_enabled(3)."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    text = os.environ.get("WATCHDOG_USEC", "0")
    return int(text) / 1e6 if text.isdigit() else 0.0
