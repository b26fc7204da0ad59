"""A worker process: `python -m spiked_service.worker ROLE` takes one order from stdin and carries it out.

What its role needs is imported before the order comes, so that a worker can stand by and begin within milliseconds.
"""

import importlib
import os
import select
import sys
import threading
from collections.abc import Callable
from typing import Any, TextIO

from pydantic import BaseModel

from spiked.errors import SpikedError
from spiked_service.messages import STOP, Refused, Role, orders
from spiked_service.worker_logs import join_logs

_GRACE_S = 0.8
"""A worker that the service has left, or left alone, ends by itself within this time, whatever it is doing."""


class Link:
    """The worker's end of its pipes."""

    def __init__(self, orders_in: TextIO, news_out: TextIO) -> None:
        self._orders = orders_in
        self._news = news_out
        self._telling = threading.Lock()
        self.stop = threading.Event()
        """Set when the worker shall end in good order."""
        self.leave = threading.Event()
        """Set when the worker shall leave at once, because the service said so or is gone."""
        self._left = threading.Event()
        threading.Thread(target=self._watch, name="orders", daemon=True).start()

    def tell(self, news: BaseModel) -> None:
        """Send news; a service that is gone does not hear it, and this worker is about to leave."""
        try:
            with self._telling:
                self._news.write(news.model_dump_json() + "\n")
                self._news.flush()
        except BrokenPipeError:
            self._abandon()

    def mention(self, news: BaseModel) -> bool:
        """Send news that another will follow, unless the service is slow to listen: then they are dropped."""
        _, ready, _ = select.select([], [self._news], [], 0)
        if ready:
            self.tell(news)
        return bool(ready)

    def _watch(self) -> None:
        for line in self._orders:
            if line == STOP:
                self.stop.set()
        self._abandon()
        self._left.wait(_GRACE_S)
        os._exit(1)

    def _abandon(self) -> None:
        self.stop.set()
        self.leave.set()


def _carrier(role: Role) -> Callable[[Any, Link], None]:
    """The function of a role, from a module that only workers of this role load."""
    module = importlib.import_module(f"spiked_service.roles.{role}")
    carrier: Callable[[Any, Link], None] = getattr(module, f"run_{role}")
    return carrier


def main() -> int:
    """Entry point of the process; the exit code is 2 for what is the user's to mend."""
    # Libraries may print: what they print belongs into the log, so the pipe of the news gets a descriptor of its own.
    news_out = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    carry_out = _carrier(Role(sys.argv[1]))
    line = sys.stdin.readline()
    if not line:
        return 0  # it stood by and was not needed
    link = Link(sys.stdin, news_out)
    order = orders.validate_json(line)
    join_logs(order, link.mention)
    try:
        carry_out(order, link)
    except SpikedError as error:
        link.tell(Refused(reason=str(error)))
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    code = main()
    # Not sys.exit: the watching thread holds stdin, and waiting for it at the interpreter's end would be for ever.
    sys.stderr.flush()
    os._exit(code)
