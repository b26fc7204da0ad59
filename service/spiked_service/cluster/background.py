"""Work on a thread of its own, for as long as a context is entered."""

import threading
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Background(ABC):
    """Runs `_run` on a thread while it is entered. A context manager."""

    def __init__(self, name: str) -> None:
        self._over = threading.Event()
        """Set at the end: `_run` returns soon then, and is waited for."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    @abstractmethod
    def _run(self) -> None:
        """The work."""
