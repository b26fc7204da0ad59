"""Responses with validators and ranges."""

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from email.utils import formatdate
from hashlib import sha256
from http import HTTPStatus
from pathlib import Path

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from spiked_service.api.problems import NotReadyError, problem

_CHUNK_BYTES = 1 << 20
"""Bytes read and sent at a time."""
_RANGE = re.compile(r"bytes=([0-9]*)-([0-9]*)")
_FAR = 10**18
"""Larger than any file; longer numbers are not parsed."""
_OCTETS = "application/octet-stream"


def etag(*parts: object) -> str:
    """A strong validator from the values that the content depends on."""
    # Their digest: a comma in a validator would end it in If-None-Match.
    return f'"{sha256("-".join(str(part) for part in parts).encode()).hexdigest()[:32]}"'


def stamp(path: Path) -> str:
    """A validator from inode, size and time of a file. Raises NotReadyError if it does not exist."""
    stat = _stat(path)
    return f"{stat.st_size:x}-{stat.st_mtime_ns:x}"


def unchanged(request: Request, tag: str) -> bool:
    """Whether If-None-Match shows that the client has the content."""
    known = request.headers.get("if-none-match", "")
    return known.strip() == "*" or tag in [one.strip().removeprefix("W/") for one in known.split(",")]


def not_modified(tag: str) -> Response:
    """The 304 response."""
    return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=_validators(tag))


def attached(tag: str, filename: str) -> dict[str, str]:
    """Headers of a download."""
    return {**_validators(tag), **_named(filename)}


def content(
    request: Request, body: bytes, media_type: str, tag: str, filename: str | None = None, **headers: str
) -> Response:
    """Response with bytes: all, the requested range, or 304."""
    if unchanged(request, tag):
        return not_modified(tag)
    named = {} if filename is None else _named(filename)
    return _part(request, len(body), {**_validators(tag), **named, **headers}, (tag,)).response(
        lambda first, count: Response(body[first : first + count], media_type=media_type)
    )


def ranged(request: Request, path: Path, filename: str, media_type: str = _OCTETS, **headers: str) -> Response:
    """Response with a file: all, the requested range, or 304. Raises NotReadyError if it does not exist."""
    stat = _stat(path)
    tag = etag(stamp(path))
    if unchanged(request, tag):
        return not_modified(tag)
    modified = formatdate(stat.st_mtime, usegmt=True)
    headers = {**_validators(tag), **_named(filename), **headers, "Last-Modified": modified}
    return _part(request, stat.st_size, headers, (tag, modified)).response(
        lambda first, count: StreamingResponse(_chunks(path, first, count), media_type=media_type)
    )


@dataclass(frozen=True)
class _Part:
    """The bytes of a response: all, a range, or none if the range is outside."""

    first: int
    count: int
    status: HTTPStatus
    headers: dict[str, str]
    refused: Response | None = None

    def response(self, made: Callable[[int, int], Response]) -> Response:
        if self.refused is not None:
            return self.refused
        answer = made(self.first, self.count)
        answer.status_code = self.status
        answer.headers.update({**self.headers, "Accept-Ranges": "bytes", "Content-Length": str(self.count)})
        return answer


def _part(request: Request, size: int, headers: dict[str, str], validators: tuple[str, ...]) -> _Part:
    """The range of a Range header for a content of `size` bytes, if If-Range allows (RFC 9110, 14).

    One range at a time: a list of ranges, and what cannot be understood, gets everything.
    """
    whole = _Part(0, size, HTTPStatus.OK, headers)
    wanted = _RANGE.fullmatch(request.headers.get("range", "").replace(" ", "").lower())
    if not wanted or wanted.groups() == ("", "") or request.headers.get("if-range", validators[0]) not in validators:
        return whole
    begin, end = (_number(digits) for digits in wanted.groups())
    if begin is not None and end is not None and end < begin:
        return whole  # an invalid range is ignored
    first = max(0, size - (end or 0)) if begin is None else begin
    last = size - 1 if begin is None or end is None else min(size - 1, end)
    if first >= size or (begin is None and end == 0):
        refused = problem(
            HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
            f"there are {size} bytes; the range {wanted[1][:20]}-{wanted[2][:20]} lies outside",
            {"Content-Range": f"bytes */{size}"},
            instance=request.url.path,
        )
        return _Part(0, 0, HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, {}, refused)
    ranged_headers = {**headers, "Content-Range": f"bytes {first}-{last}/{size}"}
    return _Part(first, last - first + 1, HTTPStatus.PARTIAL_CONTENT, ranged_headers)


def _number(digits: str) -> int | None:
    significant = digits.lstrip("0")
    if not digits:
        return None
    return _FAR if len(significant) > 18 else int(significant or "0")


def _chunks(path: Path, first: int, count: int) -> Iterator[bytes]:
    with path.open("rb") as file:
        file.seek(first)
        while count > 0 and (chunk := file.read(min(count, _CHUNK_BYTES))):
            count -= len(chunk)
            yield chunk


def _stat(path: Path) -> os.stat_result:
    try:
        return path.stat()
    except OSError as error:
        raise NotReadyError(f"{path.name} does not exist: {error.strerror}") from error


def _validators(tag: str) -> dict[str, str]:
    return {"ETag": tag, "Cache-Control": "no-cache"}


def _named(filename: str) -> dict[str, str]:
    return {"Content-Disposition": f'attachment; filename="{filename}"'}
