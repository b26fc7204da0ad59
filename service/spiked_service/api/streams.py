"""Streaming responses that release their concurrency limit and time out when the client stops reading."""

import asyncio
from collections.abc import AsyncIterable, Callable, Iterable, Mapping, MutableMapping
from typing import Any

from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

STUCK_S = 30.0
"""The connection of a client that reads nothing for this long is closed."""


class GuardedStream(StreamingResponse):
    """Streams until the end, a disconnect or a timeout; then calls `over`."""

    def __init__(
        self,
        content: AsyncIterable[str] | Iterable[str] | Iterable[bytes],
        media_type: str,
        headers: Mapping[str, str],
        over: Callable[[], None],
    ) -> None:
        super().__init__(content, media_type=media_type, headers=headers)
        self._over = over

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the response (ASGI)."""

        async def send_in_time(message: MutableMapping[str, Any]) -> None:
            async with asyncio.timeout(STUCK_S):
                await send(message)

        try:
            await super().__call__(scope, receive, send_in_time)
        except TimeoutError:
            return
        finally:
            self._over()
