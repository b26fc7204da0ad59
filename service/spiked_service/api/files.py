"""Answers that are files or versions of something: validators, ranges."""

import os
import re
from collections.abc import Iterator
from email.utils import formatdate
from http import HTTPStatus
from pathlib import Path

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from spiked_service.api.problems import NotReadyError, problem

_CHUNK_BYTES = 1 << 20
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_OCTETS = "application/octet-stream"


def etag(*parts: object) -> str:
    """A strong validator made of what the content depends on."""
    return '"' + "-".join(str(part) for part in parts) + '"'


def stamp(path: Path) -> str:
    """What changes when a file is replaced or written to. Raises NotReadyError when it is not there."""
    stat = _stat(path)
    return f"{stat.st_size:x}-{stat.st_mtime_ns:x}"


def unchanged(request: Request, tag: str) -> bool:
    """Whether the client has it already, by If-None-Match."""
    known = request.headers.get("if-none-match", "")
    return known.strip() == "*" or tag in [one.strip().removeprefix("W/") for one in known.split(",")]


def not_modified(tag: str) -> Response:
    """The answer then."""
    return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=_validators(tag))


def content(
    request: Request, body: bytes, media_type: str, tag: str, filename: str | None = None, **headers: str
) -> Response:
    """Bytes with a validator, or 304 if the client has them."""
    if unchanged(request, tag):
        return not_modified(tag)
    named = {} if filename is None else _named(filename)
    return Response(body, media_type=media_type, headers={**_validators(tag), **named, **headers})


def ranged(request: Request, path: Path, filename: str, media_type: str = _OCTETS, **headers: str) -> Response:
    """A file, or the part of it that a Range header asks for, if If-Range allows (RFC 9110, 14).

    One range at a time: a list of ranges, and what cannot be understood, gets the whole file. Raises NotReadyError when
    the file is not there.
    """
    stat = _stat(path)
    tag, size = etag(stamp(path)), stat.st_size
    if unchanged(request, tag):
        return not_modified(tag)
    modified = formatdate(stat.st_mtime, usegmt=True)
    headers = {
        **_validators(tag),
        **_named(filename),
        **headers,
        "Last-Modified": modified,
        "Accept-Ranges": "bytes",
    }
    first, last, status = 0, size - 1, HTTPStatus.OK
    wanted = _RANGE.fullmatch(request.headers.get("range", "").replace(" ", "").lower())
    if wanted and wanted.groups() != ("", "") and request.headers.get("if-range", tag) in (tag, modified):
        begin, end = wanted.groups()
        first = int(begin) if begin else max(0, size - int(end))
        last = min(size - 1, int(end)) if begin and end else size - 1
        if begin and end and int(end) < int(begin):
            first, last = 0, size - 1  # such a range is invalid, and to be ignored
        elif first >= size or (not begin and int(end) == 0):
            return problem(
                HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
                f"the file has {size} bytes; the range {begin}-{end} lies outside",
                {"Content-Range": f"bytes */{size}"},
                instance=request.url.path,
            )
        else:
            status = HTTPStatus.PARTIAL_CONTENT
            headers["Content-Range"] = f"bytes {first}-{last}/{size}"
    count = last - first + 1
    headers["Content-Length"] = str(count)
    if request.method == "HEAD":
        return Response(status_code=status, media_type=media_type, headers=headers)
    return StreamingResponse(_chunks(path, first, count), status, headers, media_type)


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
        raise NotReadyError(f"{path.name} is not there: {error.strerror}") from error


def _validators(tag: str) -> dict[str, str]:
    return {"ETag": tag, "Cache-Control": "no-cache"}


def _named(filename: str) -> dict[str, str]:
    return {"Content-Disposition": f'attachment; filename="{filename}"'}
