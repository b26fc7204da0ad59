"""Other commands of this program, each in a process of its own: what one of them needs is free when it ends."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from spiked.lifetime import ending_with_this
from spiked_service.base.signals import handling

INTERRUPTED = 130
"""Exit status of a command that was interrupted, and wrote what there was."""


def run_spiked(arguments: list[str], log: Path, show: Callable[[str], None]) -> int:
    """Run `spiked ARGUMENTS` and return its exit status. Its lines go to `log`, appended, and to `show`.

    Ctrl-C reaches it as it reaches this process; SIGTERM is passed on. Either way its end is waited for. It is killed
    when this process is.
    """
    command = [sys.executable, "-m", "spiked_service", *arguments]
    with log.open("a", encoding="utf-8") as file:
        file.write(f"$ spiked {' '.join(arguments)}\n")
        file.flush()
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            preexec_fn=ending_with_this(),  # noqa: PLW1509 - it takes no lock that a thread may hold
        )
        assert process.stdout is not None
        with _passed_on(process):
            for line in process.stdout:
                file.write(line)
                file.flush()
                show(line.rstrip("\n"))
            return process.wait()


@contextmanager
def _passed_on(process: subprocess.Popen[str]) -> Iterator[None]:
    def wait(number: int, frame: FrameType | None) -> None:
        pass  # the terminal sends it to the other process, too

    def end(number: int, frame: FrameType | None) -> None:
        process.terminate()

    with handling({signal.SIGINT: wait, signal.SIGTERM: end}):
        yield
