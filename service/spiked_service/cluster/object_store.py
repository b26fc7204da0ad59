"""The object store of a job's files: any URI that fsspec knows, such as `file:///shared/jobs` or `s3://bucket/jobs`."""

import asyncio
import errno
import hashlib
import os
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import fsspec

from spiked.errors import ConfigurationError, SpikedError
from spiked_service.cluster.messages import StoredFile

_Done = TypeVar("_Done")
_DELAYS_S = (0.2, 1.0, 3.0, 8.0)
"""Delays before an operation is repeated that failed."""
_CONNECT_S = 5
"""Time to reach S3."""
_READ_S = 15
"""Silence of S3, when it is its turn, after which a request has failed."""
_REQUESTS = 2
"""How often a request to S3 is sent before the operation that it belongs to has failed; twice as often to read."""
_QUIET_S = 60.0
"""Time without progress after which an operation has failed: a store that stops reading has no other limit."""
_LOOK_S = 0.5
"""Interval at which an operation is looked at."""
_PART_BYTES = 8 << 20
"""What is read or written by one request, so that it moves within `_QUIET_S` at 300 kB/s and more, and ..."""
_AT_ONCE = 2
"""... so many of them at once."""
_MOST_PARTS = 10_000
"""Parts of an object, as S3 has it."""


class ObjectStoreError(SpikedError):
    """The store does not answer, or an object is missing or damaged, after several attempts."""


class ObjectStore:
    """Objects below one URI. Operations are repeated a few times before they raise ObjectStoreError.

    None of them waits for ever, and what is read is compared with its SHA-256, so a truncated answer is no answer.
    """

    def __init__(self, uri: str, check: Callable[[], None] = lambda: None) -> None:
        """`check` raises once the files are wanted no more: whatever goes on then ends within a second.

        It is called on any thread. Raises ConfigurationError for a URI that cannot be used.
        """
        self.uri = uri
        self._check = check
        try:
            # Listings are not kept: other machines write, too.
            self._files, self._root = fsspec.core.url_to_fs(uri, use_listings_cache=False, **_options(uri))
        except (ImportError, ValueError, OSError) as error:
            raise ConfigurationError(f"{uri} cannot be used as a store: {error}") from error
        if self._is("s3"):
            self._files.retries = _REQUESTS

    @property
    def local(self) -> bool:
        """Whether it is a folder of a file system, which all machines share."""
        return self._is("file")

    def below(self, *names: str) -> "ObjectStore":
        """The store of a folder in it."""
        return ObjectStore("/".join([self.uri.rstrip("/"), *names]), self._check)

    def until(self, check: Callable[[], None]) -> "ObjectStore":
        """The same store, for files that are wanted until `check` raises."""
        return ObjectStore(self.uri, check)

    def put_file(self, path: Path, name: str, stored: StoredFile) -> None:
        """Store a file."""

        def put() -> None:
            self._make_parent(name)
            self._upload(path, self._at(name), stored.bytes)
            if self._size(name) != stored.bytes:
                raise OSError(f"{self.uri}/{name} was stored in part")

        self._repeated(put, f"{path.name} cannot be stored")

    def has(self, name: str, stored: StoredFile) -> bool:
        """Whether there is an object of a file's size: names that are asked for are hashes of the content."""
        return self._repeated(lambda: self._size(name) == stored.bytes, f"{stored.name} cannot be looked for")

    def put(self, name: str, content: bytes) -> None:
        """Store bytes."""

        def put() -> None:
            self._make_parent(name)
            self._call("pipe_file", self._at(name), content)
            if self._read(name) != content:
                raise OSError(f"{self.uri}/{name} was stored in part")

        self._repeated(put, f"{name} cannot be stored")

    def get(self, name: str) -> bytes | None:
        """The bytes of an object, None if there is none."""

        def get() -> bytes | None:
            try:
                return self._read(name)
            except FileNotFoundError:
                return None

        return self._repeated(get, f"{name} cannot be read")

    def fetch(self, name: str, path: Path, stored: StoredFile) -> None:
        """Write an object to a file, which appears whole."""
        part = path.with_name(f"{path.name}.part")

        def fetch() -> None:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._download(name, part, stored.bytes)
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
                self._call("rm", self._root, recursive=True)

        self._repeated(remove, "files of an ended attempt cannot be removed")
        if self.local:
            with suppress(OSError):  # it has others, or somebody has removed it
                Path(self._root).parent.rmdir()

    def end_uploads(self, is_over: Callable[[str], bool]) -> int:
        """Give up uploads in parts that nobody goes on with: S3 keeps what came of them, and lists it nowhere else.

        `is_over` takes the name of the object, below this store. Returns how many; 0 for a store without such things.
        """
        if not self._is("s3"):
            return 0
        bucket, _, key = self._root.partition("/")
        prefix = f"{key.rstrip('/')}/"

        def end() -> int:
            try:
                found = self._call("call_s3", "list_multipart_uploads", Bucket=bucket, Prefix=prefix).get("Uploads", [])
            except OSError as error:
                if error.errno == errno.ENOSYS:
                    return 0
                raise
            over = [one for one in found if one["Key"].startswith(prefix) and is_over(one["Key"].removeprefix(prefix))]
            for one in over:
                with suppress(FileNotFoundError):  # it has ended meanwhile
                    self._call("abort_mpu", bucket, one["Key"], one["UploadId"])
            return len(over)

        return self._repeated(end, "uploads that nobody goes on with cannot be ended")

    def _list(self, kind: str) -> list[str]:
        def found() -> list[str]:
            try:
                entries = self._call("ls", self._root, detail=True)
            except FileNotFoundError:
                return []
            return [PurePosixPath(one["name"]).name for one in entries if one["type"] == kind]

        return self._repeated(found, "what is in it cannot be listed")

    def _is(self, protocol: str) -> bool:
        found = self._files.protocol
        return protocol in ((found,) if isinstance(found, str) else found)

    def _at(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _make_parent(self, name: str) -> None:
        if self._is("file"):
            Path(self._at(name)).parent.mkdir(parents=True, exist_ok=True)

    def _size(self, name: str) -> int | None:
        try:
            found: dict[str, Any] = self._call("info", self._at(name))
        except FileNotFoundError:
            return None
        return int(found["size"])

    def _read(self, name: str) -> bytes:
        """An object. S3 is not asked for its size first, as it is without a range."""
        try:
            return bytes(self._call("cat_file", self._at(name), start=0))
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
        return bytes(self._call("cat_file", self._at(name)))  # it is empty, which is no range

    def _upload(self, path: Path, at: str, size: int) -> None:
        part_bytes = max(_PART_BYTES, -(-size // _MOST_PARTS))
        parts = {"chunksize": part_bytes, "max_concurrency": _AT_ONCE} if self._is("s3") else {}
        self._call("put_file", os.fspath(path), at, **parts)

    def _download(self, name: str, path: Path, size: int) -> None:
        """Write an object to a file by ranges, each of which is repeated for itself: a recording has thousands."""
        if not self._files.async_impl:
            self._call("get_file", self._at(name), os.fspath(path))
            return
        with path.open("wb") as file:
            for start in range(0, size, _PART_BYTES):
                end = min(start + _PART_BYTES, size)

                def read(start: int = start, end: int = end) -> bytes:
                    content = bytes(self._call("cat_file", self._at(name), start=start, end=end))
                    if len(content) != end - start:
                        raise OSError(f"it has {start + len(content)} bytes instead of {size}, or was read in part")
                    return content

                file.write(self._repeated(read, f"{name} cannot be read"))

    def _call(self, method: str, *given: Any, **more: Any) -> Any:
        """Have the file system do something. Raises what it raises, and TimeoutError if it does nothing for long."""
        self._check()
        if not self._files.async_impl:
            return getattr(self._files, method)(*given, **more)
        moved = fsspec.Callback()
        if method == "put_file":
            more["callback"] = moved
        work = getattr(self._files, f"_{method}")(*given, **more)
        watched = _watched(work, lambda: moved.value, self._check)
        return asyncio.run_coroutine_threadsafe(watched, self._files.loop).result()

    def _repeated(self, work: Callable[[], _Done], what: str) -> _Done:
        for delay_s in (*_DELAYS_S, None):
            try:
                return work()
            except ObjectStoreError:
                raise  # it was repeated as part of this
            except Exception as error:  # stores raise what they like
                self._check()
                if delay_s is None:
                    tries = f"after {len(_DELAYS_S) + 1} tries: {error or type(error).__name__}"
                    raise ObjectStoreError(f"{what}, {tries}; check the store {self.uri}") from error
                self._pause(delay_s)
                self._files.invalidate_cache()
        raise AssertionError

    def _pause(self, delay_s: float) -> None:
        until_s = time.monotonic() + delay_s
        while (left_s := until_s - time.monotonic()) > 0:
            time.sleep(min(left_s, _LOOK_S))
            self._check()


async def _watched(work: Coroutine[Any, Any, _Done], moved: Callable[[], float], check: Callable[[], None]) -> _Done:
    """Wait for an operation as long as it moves something. Raises what it and `check` raise, and TimeoutError."""
    clock = asyncio.get_running_loop().time
    task = asyncio.ensure_future(work)
    seen, since_s = moved(), clock()
    try:
        while True:
            done, _ = await asyncio.wait({task}, timeout=min(_LOOK_S, _QUIET_S))
            if done:
                return task.result()
            check()
            if moved() != seen:
                seen, since_s = moved(), clock()
            elif clock() - since_s > _QUIET_S:
                raise TimeoutError(f"nothing was moved for {_QUIET_S:.0f} s")
    finally:
        task.cancel()


def _options(uri: str) -> dict[str, Any]:
    """For the file system of a URI: those of S3 would repeat a request 25 times."""
    if uri.partition("://")[0] not in ("s3", "s3a"):
        return {}
    limits = {"connect_timeout": _CONNECT_S, "read_timeout": _READ_S, "retries": {"total_max_attempts": 1}}
    return {"config_kwargs": limits}


def sha256_of(path: Path) -> str:
    """Hash of a file's content, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def stored_file(path: Path, name: str) -> StoredFile:
    """What is to be known of a file to store it under its hash."""
    return StoredFile(name=name, bytes=path.stat().st_size, sha256=sha256_of(path))
