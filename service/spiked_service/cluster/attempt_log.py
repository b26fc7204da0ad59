"""The log of a job whose attempts run on other machines: what each has said, with lines that say which and where."""

from pathlib import Path

_MOST_BYTES = 1_000_000
"""Of the log of one attempt, and of those before it: the newest lines are kept."""
_CUT = b"(earlier lines were removed)\n"
"""First line of a part that was too long."""


class AttemptLog:
    """The part of one attempt in the log of its job. Not thread-safe."""

    def __init__(self, path: Path, attempt: str) -> None:
        """`path` may have the parts of earlier attempts, and that of this one, if the service was restarted."""
        self._path = path
        self._attempt = attempt
        content = path.read_bytes() if path.exists() else b""
        mark = f"== attempt {attempt} on ".encode()
        before, found, own = content.partition(mark)
        self._before = _newest(before)
        header, _, self._said = own.partition(b"\n")
        self._header = found + header + b"\n" if found else b""
        self.arriving = path.with_name(f"{path.name}-{attempt}.part")
        """Where the newest log of the attempt is to be written."""

    def begin(self, node: str) -> None:
        """A machine has taken the attempt. Raises OSError."""
        self._header = f"== attempt {self._attempt} on {' '.join(node.split())} ==\n".encode()
        self._write()

    def take(self) -> None:
        """The newest log of the attempt has been written to `arriving`. Raises OSError."""
        self._said = self.arriving.read_bytes()
        self.arriving.unlink()
        self._write()

    def end(self, trouble: str) -> None:
        """The attempt is over. Raises OSError."""
        if self._header:
            self._write(f"== attempt {self._attempt} has ended: {' '.join(trouble.split())} ==\n".encode())

    def _write(self, last: bytes = b"") -> None:
        said = _newest(self._said)
        if last and said and not said.endswith(b"\n"):
            said += b"\n"
        part = self._path.with_name(f"{self._path.name}.part")
        part.write_bytes(self._before + self._header + said + last)
        part.replace(self._path)


def _newest(content: bytes) -> bytes:
    """The last lines, as many as may be kept."""
    if len(content) <= _MOST_BYTES:
        return content
    kept = content[-_MOST_BYTES:]
    return _CUT + kept[kept.find(b"\n") + 1 :]
