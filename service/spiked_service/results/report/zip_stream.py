"""ZIP archives that are sent while they are made: no more of them is in memory than a piece."""

import io
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any

_EARLIEST = datetime(1980, 1, 1)
"""ZIP has no earlier times."""


@dataclass(frozen=True)
class Part:
    """A file of an archive."""

    name: str
    content: Iterable[bytes]
    packed: bool = True
    """Compressed; not worth it for pictures and spikes."""


def zip_pieces(parts: Iterable[Part], at: datetime | None = None) -> Iterator[bytes]:
    """An archive of the parts, piece by piece; `at` is the time of all of them."""
    sent = _Sent()
    time = _EARLIEST if at is None else max(at.replace(tzinfo=None), _EARLIEST)
    with zipfile.ZipFile(sent, "w", zipfile.ZIP_STORED) as archive:
        for part in parts:
            info = zipfile.ZipInfo(part.name, time.timetuple()[:6])
            info.compress_type = zipfile.ZIP_DEFLATED if part.packed else zipfile.ZIP_STORED
            info.external_attr = 0o644 << 16
            with archive.open(info, "w", force_zip64=True) as file:
                for piece in part.content:
                    file.write(piece)
                    if sent.waiting:
                        yield sent.taken()
            yield sent.taken()
    yield sent.taken()


class _Sent(io.RawIOBase):
    """A buffer that a ZIP file is written to and read from in pieces."""

    def __init__(self) -> None:
        super().__init__()
        self._parts: list[bytes] = []
        self._bytes = 0

    @property
    def waiting(self) -> bool:
        """Whether enough has come to be sent."""
        return self._bytes >= 1 << 16

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._parts.append(bytes(data))
        self._bytes += len(self._parts[-1])
        return len(self._parts[-1])

    def taken(self) -> bytes:
        """What has come since the last call."""
        whole = b"".join(self._parts)
        self._parts.clear()
        self._bytes = 0
        return whole
