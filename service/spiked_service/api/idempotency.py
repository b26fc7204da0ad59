"""Idempotency keys: a POST that is sent again, because its answer was lost, does its work once.

The answers are kept in the catalogue for a day. A key is bound to one request: method, path and body.
"""

import hashlib
import json
import re
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute

from spiked_service.api.problems import ConflictError, KeyReusedError
from spiked_service.store.catalogue import Catalogue

_KEPT = timedelta(days=1)
_KEY = re.compile("[!-~]{1,255}")
_HEADERS = ("location", "content-type", "etag")

IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        pattern="^[!-~]+$",
        description="Any text, new for each new request. Sent again with the same one, the request is not carried out "
        "again: the first answer comes again, with `Idempotency-Replayed: true`. Remembered for a day.",
    ),
]


@dataclass(frozen=True)
class Answer:
    """What was answered."""

    status: int
    headers: dict[str, str]
    body: bytes


class IdempotencyKeys:
    """Answers by key, in a table of the catalogue."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        with catalogue.transaction() as connection:
            connection.execute(
                "CREATE TABLE IF NOT EXISTS idempotency (key TEXT PRIMARY KEY, fingerprint TEXT NOT NULL, "
                "at TEXT NOT NULL, status INTEGER, headers TEXT, body BLOB) WITHOUT ROWID"
            )
            # What a service that died was doing is not being done any more.
            connection.execute("DELETE FROM idempotency WHERE status IS NULL")

    def begin(self, key: str, fingerprint: str) -> Answer | None:
        """The answer given before, or None: carry it out, then `finish` or `abandon` it.

        Raises KeyReusedError for a key of another request, and ConflictError while the first is being carried out.
        """
        now = datetime.now(UTC)
        with self._catalogue.transaction() as connection:
            connection.execute("DELETE FROM idempotency WHERE at < ?", ((now - _KEPT).isoformat(),))
            known = connection.execute(
                "SELECT fingerprint, status, headers, body FROM idempotency WHERE key = ?", (key,)
            ).fetchone()
            if known is None:
                connection.execute(
                    "INSERT INTO idempotency (key, fingerprint, at) VALUES (?, ?, ?)",
                    (key, fingerprint, now.isoformat()),
                )
                return None
        if known[0] != fingerprint:
            raise KeyReusedError(f"the idempotency key {key} came with another request before")
        if known[1] is None:
            raise ConflictError(f"the request with the idempotency key {key} is being carried out; ask again for it")
        return Answer(known[1], json.loads(known[2]), known[3])

    def finish(self, key: str, answer: Answer) -> None:
        """Keep the answer."""
        with self._catalogue.transaction() as connection:
            connection.execute(
                "UPDATE idempotency SET status = ?, headers = ?, body = ? WHERE key = ?",
                (answer.status, json.dumps(answer.headers), answer.body, key),
            )

    def abandon(self, key: str) -> None:
        """It came to nothing; it may be tried again."""
        with self._catalogue.transaction() as connection:
            connection.execute("DELETE FROM idempotency WHERE key = ? AND status IS NULL", (key,))


def idempotent(keys: IdempotencyKeys) -> type[APIRoute]:
    """The class of routes whose POSTs heed `Idempotency-Key`. Only what went well is remembered."""

    class IdempotentRoute(APIRoute):
        def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
            carry_out = super().get_route_handler()

            async def handle(request: Request) -> Response:
                key = request.headers.get("idempotency-key")
                if key is None or request.method != "POST" or not _KEY.fullmatch(key):
                    return await carry_out(request)
                known = await run_in_threadpool(keys.begin, key, await _fingerprint(request))
                if known is not None:
                    return Response(known.body, known.status, {**known.headers, "Idempotency-Replayed": "true"})
                try:
                    response = await carry_out(request)
                    if response.status_code < HTTPStatus.BAD_REQUEST:
                        headers = {name: response.headers[name] for name in _HEADERS if name in response.headers}
                        answer = Answer(response.status_code, headers, bytes(response.body))
                        await run_in_threadpool(keys.finish, key, answer)
                finally:
                    await run_in_threadpool(keys.abandon, key)
                return response

            return handle

    return IdempotentRoute


async def _fingerprint(request: Request) -> str:
    head = f"{request.method} {request.url.path}?{request.url.query}\n".encode()
    return hashlib.sha256(head + await request.body()).hexdigest()
