"""A worker's log: its own file, and lines from `info` up in the service's log."""

import logging
import sys
from collections.abc import Callable

from spiked_service.messages import Logged, Order


def join_logs(order: Order, tell: Callable[[Logged], object]) -> None:
    """What this process logs from now on goes both ways; `tell` may drop lines, as a log must not hold up work."""
    ids = {"capture_id": order.capture_id, "reconstruction_id": order.reconstruction_id}
    known = {"role": str(order.role), **{name: value for name, value in ids.items() if value is not None}}
    written = logging.StreamHandler(sys.stderr)
    written.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.handlers = [written, _ToService(known, tell)]
    root.setLevel(logging.INFO)


class _ToService(logging.Handler):
    def __init__(self, known: dict[str, str], tell: Callable[[Logged], object]) -> None:
        super().__init__()
        self._known = known
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        event = record.getMessage()
        if record.exc_info and record.exc_info[1] is not None:
            event = f"{event}: {record.exc_info[1]!r}"
        self._tell(Logged(level=record.levelname.lower(), event=event, logger=record.name, known=self._known))
