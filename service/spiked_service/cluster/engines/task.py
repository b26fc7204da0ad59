"""The protocol of an engine's module."""

from collections.abc import Sequence
from typing import Protocol


class Tasks(Protocol):
    """Starts agents on other machines. Called from one thread."""

    def submit(self, attempt: str, arguments: Sequence[str]) -> None:
        """Have `run_agent(*arguments)` run where there is room. Raises any exception."""
        ...

    def cancel(self, attempt: str) -> None:
        """End what is left of an attempt, also of one that an earlier engine has submitted, where that can be found."""
        ...

    def ended(self) -> list[tuple[str, str]]:
        """Attempts that have ended since the last call, each with a reason as a sentence, or empty."""
        ...
