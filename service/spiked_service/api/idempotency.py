"""Idempotency keys: a POST that is sent again, because its response was lost, is carried out once.

Responses are kept in the catalogue for a day. A key is bound to one request: method, path and body. Status codes follow
draft-ietf-httpapi-idempotency-key-header: 422 for a key of another request, 409 while the first one is carried out.
"""

import hashlib
import json
import re
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute

from spiked_service.api.auth.scopes import authorise
from spiked_service.api.problems import ConflictError, KeyReusedError
from spiked_service.api.schemas.base import not_null
from spiked_service.store.catalogue import Catalogue, StoreError

KEPT = timedelta(days=1)
"""Time for which the first answer to a key is stored."""
_KEY = re.compile("[!-~]{1,255}")
_UNKNOWN = 0
"""Status of a request that may have been carried out."""
_HEADERS = ("location", "content-type", "etag")

IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        pattern="^[!-~]+$",
        json_schema_extra=not_null,
        description="Any text, new for each new request. A request that is sent again with its key is not carried out "
        "again: the first answer is returned, with `Idempotency-Replayed: true`, for a day. A key that another request "
        "has used is refused with 422; one whose request is still carried out, or during which the service ended, with "
        "409.",
    ),
]


@dataclass(frozen=True)
class Answer:
    """A stored response."""

    status: int
    headers: dict[str, str]
    body: bytes


class IdempotencyKeys:
    """Responses by key, in a table of the catalogue."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        with catalogue.transaction() as connection:
            connection.execute(
                "CREATE TABLE IF NOT EXISTS idempotency (key TEXT PRIMARY KEY, fingerprint TEXT NOT NULL, "
                "at TEXT NOT NULL, status INTEGER, headers TEXT, body BLOB) WITHOUT ROWID"
            )
            connection.execute("CREATE INDEX IF NOT EXISTS idempotency_by_age ON idempotency (at)")
            # Requests of an earlier service: nobody knows how far they went.
            connection.execute("UPDATE idempotency SET status = ? WHERE status IS NULL", (_UNKNOWN,))

    def begin(self, key: str, fingerprint: str) -> Answer | None:
        """The stored response, or None: then carry the request out and call `finish` or `abandon`.

        Raises KeyReusedError for a key of another request, ConflictError while the request is being carried out.
        """
        now = datetime.now(UTC)
        with self._catalogue.transaction() as connection:
            connection.execute("DELETE FROM idempotency WHERE at < ?", ((now - KEPT).isoformat(),))
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
            raise KeyReusedError(f"the idempotency key {key} was used for another request")
        if known[1] == _UNKNOWN:
            raise ConflictError(
                f"the service ended during the request with the idempotency key {key}: look with GET whether it was "
                "carried out, and use a new key to repeat it"
            )
        if known[1] is None:
            raise ConflictError(f"the request with the idempotency key {key} is being carried out; send it again later")
        return Answer(known[1], json.loads(known[2]), known[3])

    def finish(self, key: str, answer: Answer) -> None:
        """Store the response."""
        with self._catalogue.transaction() as connection:
            connection.execute(
                "UPDATE idempotency SET status = ?, headers = ?, body = ? WHERE key = ?",
                (answer.status, json.dumps(answer.headers), answer.body, key),
            )

    def abandon(self, key: str) -> None:
        """Release the key after a failure, so that the request can be repeated."""
        with self._catalogue.transaction() as connection:
            connection.execute("DELETE FROM idempotency WHERE key = ? AND status IS NULL", (key,))


def idempotent(keys: IdempotencyKeys) -> type[APIRoute]:
    """The route class whose POSTs support `Idempotency-Key`. Only successful responses are stored."""

    class IdempotentRoute(APIRoute):
        def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
            carry_out = super().get_route_handler()

            async def handle(request: Request) -> Response:
                await authorise(request)  # before a stored response is sent
                key = request.headers.get("idempotency-key")
                if key is None or request.method != "POST" or not _KEY.fullmatch(key):
                    return await carry_out(request)
                known = await run_in_threadpool(keys.begin, key, await _fingerprint(request))
                if known is not None:
                    return Response(known.body, known.status, {**known.headers, "Idempotency-Replayed": "true"})
                carried_out = False
                try:
                    response = await carry_out(request)
                    carried_out = response.status_code < HTTPStatus.BAD_REQUEST
                    if carried_out:
                        headers = {name: response.headers[name] for name in _HEADERS if name in response.headers}
                        answer = Answer(response.status_code, headers, bytes(response.body))
                        with suppress(StoreError):  # a full disk: the key stays taken, and its answer is not repeated
                            await run_in_threadpool(keys.finish, key, answer)
                finally:
                    if not carried_out:
                        await run_in_threadpool(keys.abandon, key)
                return response

            return handle

    return IdempotentRoute


async def _fingerprint(request: Request) -> str:
    head = f"{request.method} {request.url.path}?{request.url.query}\n".encode()
    return hashlib.sha256(head + await request.body()).hexdigest()
