"""A worker process: `python -m spiked_service.workers ROLE` reads one command from stdin and executes it.

The modules of the role are imported before the command arrives, so that a standby worker starts within milliseconds.
With `--forks` the process is a server that forks into such workers.
"""

import importlib
import os
import sys
from collections.abc import Callable
from typing import Any, TextIO

from spiked.errors import SpikedError
from spiked_service.store.disk_space import DiskFullError
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.fork_server import FORKS, become_worker
from spiked_service.workers.log_forwarding import join_logs
from spiked_service.workers.messages import Role, WorkerError, commands

_NO_MEMORY = "there is not enough memory: ask for smaller frames or fewer captures, or end other programs"


def _executor(role: Role) -> Callable[[Any, WorkerChannel], None]:
    """The function that executes a role, from a module that only this role imports."""
    module = importlib.import_module(f"spiked_service.workers.roles.{role}")
    carrier: Callable[[Any, WorkerChannel], None] = getattr(module, f"run_{role}")
    return carrier


def _events_out() -> TextIO:
    """Stdout. What libraries print goes to the log instead: events get a file descriptor of their own."""
    events_out = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return events_out


def main() -> int:
    """Entry point of the process. The exit code is 2 for errors that the user can correct."""
    events_out = _events_out()
    execute = _executor(Role(sys.argv[1]))
    if FORKS in sys.argv[2:]:
        if not become_worker():
            return 0
        events_out = _events_out()
    line = sys.stdin.readline()
    if not line:
        return 0  # a standby worker that was not needed
    channel = WorkerChannel(sys.stdin, events_out)
    command = commands.validate_json(line)
    join_logs(command, channel.try_send)
    try:
        execute(command, channel)
    except (SpikedError, MemoryError) as error:
        reason = str(error) if isinstance(error, SpikedError) else _NO_MEMORY
        channel.send(WorkerError(reason=reason, disk_full=isinstance(error, DiskFullError)))
        print(reason, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    code = main()
    # Not sys.exit: a daemon thread blocks in a read of stdin, and the interpreter would wait for its lock for ever.
    sys.stderr.flush()
    os._exit(code)
