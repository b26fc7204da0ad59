"""The process of an engine: lines of JSON from the service on stdin, ended attempts on stdout."""

import importlib
import json
import math
import os
import queue
import sys
import threading
import time

from spiked_service.cluster.engine import EngineOptions
from spiked_service.cluster.engines.task import Tasks

_LOOK_S = 0.2
"""Interval at which the engine is asked for ended tasks."""


def main() -> None:
    """Serve until stdin closes. What was submitted goes on."""
    told = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # libraries print
    options = EngineOptions(**json.loads(sys.argv[1]))
    tasks: Tasks = importlib.import_module(f"spiked_service.cluster.engines.{options.kind}").tasks(options)
    orders: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(orders,), daemon=True).start()

    def tell(attempt: str, reason: str) -> None:
        told.write(json.dumps({"ended": attempt, "reason": reason}) + "\n")
        told.flush()

    due: dict[str, float] = {}  # when attempts that are over are cancelled
    while True:
        for attempt, reason in tasks.ended():
            due[attempt] = min(due.get(attempt, math.inf), time.monotonic())
            tell(attempt, reason)
        for attempt in [one for one, at_s in due.items() if at_s <= time.monotonic()]:
            del due[attempt]
            tasks.cancel(attempt)
            tell(attempt, "it was cancelled")
        try:
            line = orders.get(timeout=_LOOK_S)
        except queue.Empty:
            continue
        if line is None:
            return
        order = json.loads(line)
        if "keep" in order:
            due.pop(order["keep"], None)
            continue
        if "cancel" in order:
            due[order["cancel"]] = time.monotonic() + order["after_s"]
            continue
        try:
            tasks.submit(order["submit"], order["arguments"])
        except Exception as error:  # of any library
            tell(order["submit"], f"{options.kind} has refused it: {error}")


def _read(orders: "queue.SimpleQueue[str | None]") -> None:
    for line in sys.stdin:
        orders.put(line)
    orders.put(None)


if __name__ == "__main__":
    main()
    sys.stderr.flush()
    os._exit(0)  # threads of libraries must not keep it
