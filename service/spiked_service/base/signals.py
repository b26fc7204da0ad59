"""Handlers of signals for a while, an end by a signal that cleans up, and a read that signals interrupt."""

import os
import select
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], object] | signal.Handlers


def ending_signals() -> tuple[signal.Signals, ...]:
    """SIGTERM, and SIGHUP unless it is ignored: `nohup` lets a program outlive its terminal."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGTERM,) if ignored else (signal.SIGTERM, signal.SIGHUP)


class _Ended(BaseException):
    """A signal ends the program."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def handling(handlers: Mapping[signal.Signals, Handler]) -> Iterator[None]:
    """These handle their signals; afterwards those before do again."""
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextmanager
def cleaning_up() -> Iterator[None]:
    """SIGTERM and the end of the terminal end this as Ctrl-C does: unfinished files are removed.

    Then the program ends by the signal itself, as its parent expects.
    """

    def end(number: int, frame: FrameType | None) -> None:
        raise _Ended(number)

    try:
        with handling(dict.fromkeys(ending_signals(), end)):
            yield
    except _Ended as ended:
        signal.signal(ended.number, signal.SIG_DFL)
        os.kill(os.getpid(), ended.number)


@contextmanager
def holding() -> Iterator[None]:
    """Signals that end the program wait for the end of this.

    For imports: packages that catch BaseException around theirs (trimesh does) would swallow Ctrl-C.
    """
    came: list[int] = []
    with handling(dict.fromkeys((signal.SIGINT, *ending_signals()), lambda number, frame: came.append(number))):
        yield
    if came:
        signal.raise_signal(came[0])


def read_line(fd: int) -> str:
    """The next line of a file descriptor, with its end; empty at the end of the input.

    Signals are handled while this waits. A plain read would block on after a signal that came just before it, or
    that another thread took.
    """
    woken, wake = socket.socketpair()
    with woken, wake:
        wake.setblocking(False)
        before = signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
        try:
            return _line_between_signals(fd, woken)
        finally:
            signal.set_wakeup_fd(before)


def _line_between_signals(fd: int, woken: socket.socket) -> str:
    line = bytearray()
    while not line.endswith(b"\n"):
        ready, _, _ = select.select([fd, woken.fileno()], [], [])
        if woken.fileno() in ready:
            woken.recv(4096)  # a signal came; Python calls its handler, which may end this
        elif byte := os.read(fd, 1):  # what follows the line is left to the next reader
            line += byte
        else:
            break
    return line.decode(errors="replace")
