"""Events over HTTP: a WebSocket, and for `curl` and EventSource the same messages as server-sent events."""

import asyncio
from collections.abc import AsyncIterator, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, Request, WebSocket, WebSocketDisconnect
from fastapi.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from spiked.errors import ConfigurationError
from spiked_service.api.problems import problem
from spiked_service.events import PUBLISHED, Bus, Subscription, Topic
from spiked_service.limits import Gate, OverloadedError

_CAPACITY = 1024
"""Messages that wait for a client: some seconds of poses."""
_PREVIEWS = 2
_STUCK_S = 30.0
"""A client that takes nothing for this long is left."""
_HEARTBEAT_S = 15.0
"""A comment this often keeps proxies from closing a silent stream, and finds clients that are gone."""
_TURN = 4
"""Messages to one client before the others have their turn, and before a lost connection is noticed."""
_ONLY_SENDS = 1003
_STUCK = 1013


@dataclass(frozen=True)
class _Wish:
    topics: frozenset[Topic]
    since: int | None


def event_routes(bus: Bus, gate: Gate) -> APIRouter:
    """`/events`; both kinds of clients count against the gate."""
    router = APIRouter(tags=["events"])

    @router.websocket("/events")
    async def follow(websocket: WebSocket) -> None:
        try:
            wish = _wish(websocket.query_params)
            gate.enter()
        except ConfigurationError as error:
            await websocket.send_denial_response(problem(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)))
            return
        except OverloadedError as error:
            await websocket.send_denial_response(problem(HTTPStatus.SERVICE_UNAVAILABLE, str(error)))
            return
        try:
            await _serve(websocket, _subscribe(bus, wish))
        finally:
            gate.leave()

    @router.get("/events", include_in_schema=False)
    async def stream(request: Request) -> Response:
        wish = _wish({"since": request.headers.get("last-event-id", ""), **request.query_params})
        gate.enter()
        return _Stream(_subscribe(bus, wish), gate)

    return router


def _wish(query: Mapping[str, str]) -> _Wish:
    """What a client asks for: `topics=pose,scene` (all), `since=SEQ` (from now on). Raises ConfigurationError."""
    known = ", ".join(sorted(PUBLISHED))
    topics = set()
    for name in query.get("topics", "").split(","):
        if name and name not in PUBLISHED:
            raise ConfigurationError(f"there is no topic {name[:40]!r}; topics are {known}")
        if name:
            topics.add(Topic(name))
    since = query.get("since", "")
    if since and not (since.isascii() and since.isdigit() and len(since) < 19):
        raise ConfigurationError(f"since is the number of the last message you have, not {since[:40]!r}")
    return _Wish(frozenset(topics) or PUBLISHED, int(since) if since else None)


def _subscribe(bus: Bus, wish: _Wish) -> Subscription:
    return bus.subscribe(wish.topics, _CAPACITY, _PREVIEWS, wish.since)


async def _serve(websocket: WebSocket, subscription: Subscription) -> None:
    """Until the client goes, says something, or takes nothing any more."""
    await websocket.accept()
    listening = asyncio.create_task(_hear(websocket, subscription))
    try:
        sent = 0
        while (message := await subscription.next()) is not None:
            async with asyncio.timeout(_STUCK_S):
                await websocket.send_text(message.json)
            sent += 1
            if sent % _TURN == 0:
                await asyncio.sleep(0)
    except WebSocketDisconnect:
        pass
    except TimeoutError:
        with suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
            async with asyncio.timeout(1.0):
                await websocket.close(_STUCK, f"nothing was taken for {_STUCK_S:.0f} s")
    finally:
        subscription.close()
        listening.cancel()


async def _hear(websocket: WebSocket, subscription: Subscription) -> None:
    """A client has nothing to say; what it says all the same ends the conversation."""
    message = await websocket.receive()
    if message["type"] == "websocket.receive":
        with suppress(RuntimeError, WebSocketDisconnect):
            await websocket.close(_ONLY_SENDS, "this stream only sends; topics and since belong into its address")
    subscription.close()


class _Stream(StreamingResponse):
    """Server-sent events until the client goes, or takes nothing any more."""

    def __init__(self, subscription: Subscription, gate: Gate) -> None:
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        super().__init__(_lines(subscription), media_type="text/event-stream", headers=headers)
        self._subscription = subscription
        self._gate = gate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_in_time(message: MutableMapping[str, Any]) -> None:
            async with asyncio.timeout(_STUCK_S):
                await send(message)

        try:
            await super().__call__(scope, receive, send_in_time)
        except TimeoutError:
            return
        finally:
            self._subscription.close()
            self._gate.leave()


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
