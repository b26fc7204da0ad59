"""HEAD for every GET (RFC 9110, 9.3.2): the same response without its body."""

import asyncio

from starlette.types import ASGIApp, Message, Receive, Scope, Send

_ONLY_GET = (b"range", b"if-range")
"""Headers that are ignored: ranges are defined for GET only (RFC 9110, 14.2)."""


class Head:
    """ASGI middleware: runs a HEAD as a GET whose client disconnects after the headers."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        answered, received = asyncio.Event(), False

        async def headers_only(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})
                answered.set()

        async def disconnect() -> Message:
            nonlocal received
            if not received:
                received = True
                return {"type": "http.request", "body": b"", "more_body": False}
            await answered.wait()
            return {"type": "http.disconnect"}

        headers = [(name, value) for name, value in scope["headers"] if name not in _ONLY_GET]
        await self._app({**scope, "method": "GET", "headers": headers}, disconnect, headers_only)
