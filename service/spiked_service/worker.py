"""A worker process: `python -m spiked_service.worker` takes one order from stdin and carries it out.

The role in its arguments is for people who look at a list of processes.
"""

import os
import sys
import threading
from typing import TextIO

from pydantic import BaseModel

from spiked.errors import SpikedError
from spiked_service.messages import (
    STOP,
    AcquisitionOrder,
    Order,
    PreviewOrder,
    ReconstructionOrder,
    Refused,
    orders,
)

_GRACE_S = 0.8
"""A worker that the service has left, or left alone, ends by itself within this time, whatever it is doing."""


class Link:
    """The worker's end of its pipes."""

    def __init__(self, orders_in: TextIO, news_out: TextIO) -> None:
        self._orders = orders_in
        self._news = news_out
        self.stop = threading.Event()
        """Set when the worker shall end in good order."""
        self.leave = threading.Event()
        """Set when the worker shall leave at once, because the service said so or is gone."""
        self._left = threading.Event()
        threading.Thread(target=self._watch, name="orders", daemon=True).start()

    def tell(self, news: BaseModel) -> None:
        """Send news; a service that is gone does not hear it, and this worker is about to leave."""
        try:
            self._news.write(news.model_dump_json() + "\n")
            self._news.flush()
        except BrokenPipeError:
            self._abandon()

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


def carry_out(order: Order, link: Link) -> None:
    """Do what is ordered; each role's imports are its own, so that a worker loads only what it needs."""
    match order:
        case AcquisitionOrder():
            from spiked_service.roles.acquisition import run_acquisition

            run_acquisition(order, link)
        case ReconstructionOrder():
            from spiked_service.roles.reconstruction import run_reconstruction

            run_reconstruction(order, link)
        case PreviewOrder():
            from spiked_service.roles.preview import run_preview

            run_preview(order, link)


def main() -> int:
    """Entry point of the process; the exit code is 2 for what is the user's to mend."""
    # Libraries may print: what they print belongs into the log, so the pipe of the news gets a descriptor of its own.
    news_out = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    line = sys.stdin.readline()
    if not line:
        return 1
    link = Link(sys.stdin, news_out)
    try:
        carry_out(orders.validate_json(line), link)
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
