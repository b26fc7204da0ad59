"""Events over HTTP: a WebSocket, and the same messages as server-sent events for `curl` and EventSource."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus

from fastapi import APIRouter, Request, WebSocket, WebSocketDisconnect
from fastapi.responses import Response

from spiked.errors import ConfigurationError
from spiked_service.api import streams
from spiked_service.api.problems import problem
from spiked_service.api.streams import GuardedStream
from spiked_service.base.limits import ConcurrencyLimit, OverloadedError
from spiked_service.events.bus import PUBLISHED, Bus, Subscription, Topic

CAPACITY = 1024
"""Capacity of a client's queue, messages: some seconds of poses."""
_PREVIEWS = 2
"""Pictures queued for a client; older ones are dropped."""
_HEARTBEAT_S = 15.0
"""Interval of comments and empty messages, which keep proxies from closing a silent stream and detect lost
connections."""
_TURN = 4
"""Messages sent to a client before other clients are served and a lost connection is noticed."""
CLOSE_SEND_ONLY = 1003
"""Close code for a client that writes to the stream (RFC 6455, 7.4.1)."""
_STUCK = 1013
"""Close code "try again later" for a client that takes nothing."""


@dataclass(frozen=True)
class _EventQuery:
    topics: frozenset[Topic]
    since: int | None
    heartbeat: bool
    """Whether a silent WebSocket gets an empty message now and then."""


def event_routes(bus: Bus, concurrency: ConcurrencyLimit) -> APIRouter:
    """`/events`; both kinds of clients count against the limit."""
    router = APIRouter(tags=["events"])

    @router.websocket("/events")
    async def follow(websocket: WebSocket) -> None:
        try:
            wanted = _parse_query(websocket.query_params)
            concurrency.acquire()
        except ConfigurationError as error:
            await websocket.send_denial_response(problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)))
            return
        except OverloadedError as error:
            await websocket.send_denial_response(problem(HTTPStatus.SERVICE_UNAVAILABLE, str(error)))
            return
        try:
            await _serve(websocket, _subscribe(bus, wanted), heartbeat=wanted.heartbeat)
        finally:
            concurrency.release()

    @router.get("/events", include_in_schema=False)
    async def stream(request: Request) -> Response:
        wanted = _parse_query({"since": request.headers.get("last-event-id", ""), **request.query_params})
        concurrency.acquire()
        subscription = _subscribe(bus, wanted)

        def over() -> None:
            subscription.close()
            concurrency.release()

        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return GuardedStream(_lines(subscription), "text/event-stream", headers, over)

    return router


def _parse_query(query: Mapping[str, str]) -> _EventQuery:
    """Parse `topics=pose,scene` (default: all), `since=SEQ` (default: from now on) and `heartbeat=1`.

    Raises ConfigurationError.
    """
    known = ", ".join(sorted(PUBLISHED))
    topics = set()
    for name in query.get("topics", "").split(","):
        if name and name not in PUBLISHED:
            raise ConfigurationError(f"there is no topic {name[:40]!r}; topics are {known}")
        if name:
            topics.add(Topic(name))
    since = query.get("since", "")
    if since and not (since.isascii() and since.isdigit() and len(since) < 19):
        raise ConfigurationError(f"since is the number of the last message received, not {since[:40]!r}")
    heartbeat = query.get("heartbeat", "0")
    if heartbeat not in ("0", "1"):
        raise ConfigurationError(f"heartbeat is 0 or 1, not {heartbeat[:40]!r}")
    return _EventQuery(frozenset(topics) or PUBLISHED, int(since) if since else None, heartbeat == "1")


def _subscribe(bus: Bus, wanted: _EventQuery) -> Subscription:
    return bus.subscribe(wanted.topics, CAPACITY, _PREVIEWS, wanted.since)


async def _serve(websocket: WebSocket, subscription: Subscription, *, heartbeat: bool) -> None:
    """Send messages until the client disconnects, writes, or stops reading; with `heartbeat` empty ones in silence."""
    await websocket.accept()
    listening = asyncio.create_task(_hear(websocket, subscription))
    try:
        sent = 0
        while (text := await _next_text(subscription, _HEARTBEAT_S if heartbeat else None)) is not None:
            async with asyncio.timeout(streams.STUCK_S):
                await websocket.send_text(text)
            sent += 1
            if sent % _TURN == 0:
                await asyncio.sleep(0)
    except WebSocketDisconnect:
        pass
    except TimeoutError:
        with suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
            async with asyncio.timeout(1.0):
                await websocket.close(_STUCK, f"nothing was taken for {streams.STUCK_S:.0f} s")
    finally:
        subscription.close()
        listening.cancel()


async def _next_text(subscription: Subscription, silence_s: float | None) -> str | None:
    """The next message as JSON, empty after a silence, None at the end."""
    try:
        async with asyncio.timeout(silence_s):
            message = await subscription.next()
    except TimeoutError:
        return ""
    return None if message is None else message.json


async def _hear(websocket: WebSocket, subscription: Subscription) -> None:
    """Close the connection of a client that writes: the stream is send-only."""
    message = await websocket.receive()
    if message["type"] == "websocket.receive":
        with suppress(RuntimeError, WebSocketDisconnect):
            await websocket.close(CLOSE_SEND_ONLY, "this stream only sends; topics and since belong into its address")
    subscription.close()


async def _lines(subscription: Subscription) -> AsyncIterator[str]:
    yield ": spiked events\n\n"
    while True:
        try:
            async with asyncio.timeout(_HEARTBEAT_S):
                message = await subscription.next()
        except TimeoutError:
            yield ":\n\n"
            continue
        if message is None:
            return
        yield f"id: {message.seq}\nevent: {message.topic}\ndata: {message.json}\n\n"
