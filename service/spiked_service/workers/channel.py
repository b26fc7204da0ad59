"""The worker's end of its pipes to the service: commands on stdin, events on stdout."""

import os
import select
import threading
from typing import TextIO

from pydantic import BaseModel

from spiked_service.workers.messages import STOP

_EXIT_S = 0.8
"""Time from the end of stdin to the forced exit of the worker."""


class WorkerChannel:
    """Sends events and receives the service's requests to stop. `send` may be called from any thread."""

    def __init__(self, commands_in: TextIO, events_out: TextIO) -> None:
        self._commands = commands_in
        self._events = events_out
        self._sending = threading.Lock()
        self.stop = threading.Event()
        """Set when the worker should finish its work and exit."""
        self.leave = threading.Event()
        """Set when the worker should exit at once: the service closed stdin, or has died."""
        self._left = threading.Event()
        threading.Thread(target=self._watch, name="orders", daemon=True).start()

    def send(self, event: BaseModel) -> None:
        """Send an event. If the service has died, the event is dropped and `leave` is set."""
        try:
            with self._sending:
                self._events.write(event.model_dump_json() + "\n")
                self._events.flush()
        except BrokenPipeError:
            self._abandon()

    def try_send(self, event: BaseModel) -> bool:
        """Send an event unless the pipe is full. Return whether it was sent."""
        _, ready, _ = select.select([], [self._events], [], 0)
        if ready:
            self.send(event)
        return bool(ready)

    def _watch(self) -> None:
        for line in self._commands:
            if line == STOP:
                self.stop.set()
        self._abandon()
        self._left.wait(_EXIT_S)
        os._exit(1)

    def _abandon(self) -> None:
        self.stop.set()
        self.leave.set()
