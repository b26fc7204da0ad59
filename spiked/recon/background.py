"""Work on another thread whose result is taken later.

Of a recording at a point that does not depend on how long it took, of a live camera once it is there.
"""

import os
import sys
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from spiked.recon.blas import one_blas_thread

Result = TypeVar("Result")

BEHIND_NICE = 10
"""Niceness of a thread behind another, beside that of the other."""


class Background(Generic[Result]):
    """A function that runs on a thread of its own."""

    def __init__(self, work: Callable[[Callable[[], bool]], Result], behind: bool = False) -> None:
        """`work` gets a function that tells whether it is to end early.

        `behind`: the thread has less priority than the one that began it, on Linux.
        """
        self._work, self._behind = work, behind
        self._stop = threading.Event()
        self._outcome: list[Result | BaseException] = []
        self._thread = threading.Thread(target=self._run, name="background")
        self._thread.start()

    def _run(self) -> None:
        try:
            if self._behind and sys.platform == "linux":  # where priorities are those of threads
                thread = threading.get_native_id()
                os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + BEHIND_NICE)
            with one_blas_thread():
                self._outcome.append(self._work(self._is_over))
        except BaseException as error:  # raised again by `result`, on the thread that waits for it
            self._outcome.append(error)

    def _is_over(self) -> bool:
        """It was stopped, or the program ends."""
        return self._stop.is_set() or not threading.main_thread().is_alive()

    @property
    def done(self) -> bool:
        """The work has ended: `result` does not wait."""
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Let the work end early."""
        self._stop.set()

    def result(self) -> Result:
        """Wait for the end, and return the result of the work or raise its error."""
        self._thread.join()
        (outcome,) = self._outcome
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    def __reduce__(self) -> tuple[type, tuple[Result]]:
        """A copy has the result and no thread."""
        return _Done, (self.result(),)


class _Done(Background[Result]):
    """Work that was done before it was copied."""

    def __init__(self, result: Result) -> None:
        self._result = result

    @property
    def done(self) -> bool:
        """See `Background`."""
        return True

    def stop(self) -> None:
        """Nothing is left to be ended."""

    def result(self) -> Result:
        """See `Background`."""
        return self._result

    def __reduce__(self) -> tuple[type, tuple[Result]]:
        return _Done, (self._result,)
