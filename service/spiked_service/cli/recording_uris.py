"""Recordings by name: files, patterns of files, and URIs of any store that fsspec knows."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, BinaryIO

import fsspec

from spiked.errors import ConfigurationError

_WILD = "*?["
"""Characters of patterns."""


@dataclass(frozen=True)
class Found:
    """A recording in a store."""

    uri: str
    """As it is told to people."""
    path: str
    size: int
    files: Any
    """The file system of fsspec."""

    @property
    def name(self) -> str:
        """Its last part."""
        return PurePosixPath(self.path).name

    def sidecar(self) -> bytes | None:
        """Content of the sidecar beside it, if there is one. Raises OSError."""
        try:
            return bytes(self.files.cat_file(str(PurePosixPath(self.path).with_suffix(".json"))))
        except FileNotFoundError:
            return None

    @contextmanager
    def open(self) -> Iterator[BinaryIO]:
        """A file that is read by ranges. Raises OSError."""
        with self.files.open(self.path, "rb") as file:
            yield file


def find(names: list[str]) -> list[Found]:
    """The recordings that names mean, in order, each once.

    Raises ConfigurationError for a name that means none.
    """
    found: dict[str, Found] = {}
    for name in names:
        for one in _find(name):
            found.setdefault(one.uri, one)
    return list(found.values())


def _find(name: str) -> list[Found]:
    try:
        files, path = fsspec.core.url_to_fs(name)
        if any(sign in path for sign in _WILD):
            sizes = {one: int(entry["size"]) for one, entry in files.glob(path, detail=True).items() if _is_file(entry)}
        else:
            sizes = {path: int(files.info(path)["size"])}
    except FileNotFoundError:
        sizes = {}
    except (ImportError, ValueError, OSError) as error:
        raise ConfigurationError(f"{name} cannot be looked at: {error}") from error
    if not sizes:
        raise ConfigurationError(f"{name} names no file")
    return [Found(str(files.unstrip_protocol(one)), one, size, files) for one, size in sorted(sizes.items())]


def _is_file(entry: dict[str, Any]) -> bool:
    return bool(entry["type"] == "file")
