"""Logging of a worker: to its own file, and from level `info` up to the service's log."""

import logging
import sys
from collections.abc import Callable

from spiked_service.workers.messages import Command, Logged


def join_logs(command: Command, send: Callable[[Logged], object]) -> None:
    """Log to standard error and to the service through `send`, which may drop lines rather than block."""
    ids = {"capture_id": command.capture_id, "reconstruction_id": command.reconstruction_id}
    known = {"role": str(command.role), **{name: value for name, value in ids.items() if value is not None}}
    written = logging.StreamHandler(sys.stderr)
    written.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.handlers = [written, _ToService(known, send)]
    root.setLevel(logging.INFO)


class _ToService(logging.Handler):
    def __init__(self, known: dict[str, str], send: Callable[[Logged], object]) -> None:
        super().__init__()
        self._known = known
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        event = record.getMessage()
        if record.exc_info and record.exc_info[1] is not None:
            event = f"{event}: {record.exc_info[1]!r}"
        self._send(Logged(level=record.levelname.lower(), event=event, logger=record.name, known=self._known))
