"""Which rows of the catalogue were written since somebody asked."""


class WrittenRows:
    """Ids of captures, reconstructions and uploads. Not safe for threads: who uses it holds a transaction."""

    def __init__(self) -> None:
        self._ids: set[str] | None = None

    def note(self, *ids: str) -> None:
        """Rows that are written or deleted."""
        if self._ids is not None:
            self._ids.update(ids)

    def take(self) -> set[str] | None:
        """Those since the last call; None at the first one."""
        taken, self._ids = self._ids, set()
        return taken

    def stop(self) -> None:
        """Nobody asks any more; the next call of `take` is a first one."""
        self._ids = None
