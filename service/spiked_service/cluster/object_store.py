"""The object store of a job's files: any URI that fsspec knows, such as `file:///shared/jobs` or `s3://bucket/jobs`."""

import hashlib
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import fsspec

from spiked.errors import ConfigurationError, SpikedError
from spiked_service.cluster.messages import StoredFile

_Done = TypeVar("_Done")
_DELAYS_S = (0.2, 1.0, 3.0, 8.0)
"""Delays before an operation is repeated that failed."""


class ObjectStoreError(SpikedError):
    """The store does not answer, or an object is missing or damaged, after several attempts."""


class ObjectStore:
    """Objects below one URI. Operations are repeated a few times before they raise ObjectStoreError.

    What is read is compared with its SHA-256, so a truncated answer is no answer.
    """

    def __init__(self, uri: str) -> None:
        """Raises ConfigurationError for a URI that cannot be used."""
        self.uri = uri
        try:
            # Listings are not kept: other machines write, too.
            self._files, self._root = fsspec.core.url_to_fs(uri, use_listings_cache=False)
        except (ImportError, ValueError, OSError) as error:
            raise ConfigurationError(f"{uri} cannot be used as a store: {error}") from error

    @property
    def local(self) -> bool:
        """Whether it is a folder of a file system, which all machines share."""
        return "file" in self._protocols()

    def below(self, *names: str) -> "ObjectStore":
        """The store of a folder in it."""
        return ObjectStore("/".join([self.uri.rstrip("/"), *names]))

    def put_file(self, path: Path, name: str, stored: StoredFile) -> None:
        """Store a file, unless an object of its size is there: names contain the hash of the content."""

        def put() -> None:
            if self._size(name) != stored.bytes:
                self._make_parent(name)
                self._files.put_file(os.fspath(path), self._at(name))
            if self._size(name) != stored.bytes:
                raise OSError(f"{self.uri}/{name} was stored in part")

        self._repeated(put, f"{path.name} cannot be stored")

    def put(self, name: str, content: bytes) -> None:
        """Store bytes."""

        def put() -> None:
            self._make_parent(name)
            self._files.pipe_file(self._at(name), content)
            if self._files.cat_file(self._at(name)) != content:
                raise OSError(f"{self.uri}/{name} was stored in part")

        self._repeated(put, f"{name} cannot be stored")

    def get(self, name: str) -> bytes | None:
        """The bytes of an object, None if there is none."""

        def get() -> bytes | None:
            try:
                return bytes(self._files.cat_file(self._at(name)))
            except FileNotFoundError:
                return None

        return self._repeated(get, f"{name} cannot be read")

    def fetch(self, name: str, path: Path, stored: StoredFile) -> None:
        """Write an object to a file, which appears whole."""
        part = path.with_name(f"{path.name}.part")

        def fetch() -> None:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._files.get_file(self._at(name), os.fspath(part))
                if sha256_of(part) != stored.sha256:
                    raise OSError(f"{self.uri}/{name} is damaged or was read in part")
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)

        self._repeated(fetch, f"{stored.name} cannot be fetched")

    def folders(self) -> list[str]:
        """Names of the folders directly in it."""
        return self._list("directory")

    def objects(self) -> list[str]:
        """Names of the objects directly in it."""
        return self._list("file")

    def remove(self) -> None:
        """Delete all of its objects, and the folder above it if nothing else is in there."""

        def remove() -> None:
            with suppress(FileNotFoundError):
                self._files.rm(self._root, recursive=True)

        self._repeated(remove, "files of an ended attempt cannot be removed")
        if self.local:
            with suppress(OSError):  # it has others, or somebody has removed it
                Path(self._root).parent.rmdir()

    def _list(self, kind: str) -> list[str]:
        def found() -> list[str]:
            try:
                entries = self._files.ls(self._root, detail=True)
            except FileNotFoundError:
                return []
            return [PurePosixPath(one["name"]).name for one in entries if one["type"] == kind]

        return self._repeated(found, "what is in it cannot be listed")

    def _protocols(self) -> tuple[str, ...]:
        found = self._files.protocol
        return (found,) if isinstance(found, str) else tuple(found)

    def _at(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _make_parent(self, name: str) -> None:
        if "file" in self._protocols():
            Path(self._at(name)).parent.mkdir(parents=True, exist_ok=True)

    def _size(self, name: str) -> int | None:
        try:
            found: dict[str, Any] = self._files.info(self._at(name))
        except FileNotFoundError:
            return None
        return int(found["size"])

    def _repeated(self, work: Callable[[], _Done], what: str) -> _Done:
        for delay_s in (*_DELAYS_S, None):
            try:
                return work()
            except Exception as error:  # stores raise what they like
                if delay_s is None:
                    raise ObjectStoreError(f"{what}: {error or type(error).__name__}; check {self.uri}") from error
                time.sleep(delay_s)
                self._files.invalidate_cache()
        raise AssertionError


def sha256_of(path: Path) -> str:
    """Hash of a file's content, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def stored_file(path: Path, name: str) -> StoredFile:
    """What is to be known of a file to store it under its hash."""
    return StoredFile(name=name, bytes=path.stat().st_size, sha256=sha256_of(path))
