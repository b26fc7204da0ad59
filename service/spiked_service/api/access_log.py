"""Records each request: its duration for Prometheus and a line in the log."""

import time
from http import HTTPStatus

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from spiked_service.events.logging import logger
from spiked_service.operations.metrics import Metrics

_log = logger("spiked.http")
_READING = frozenset({"GET", "HEAD", "OPTIONS"})


class AccessLogMiddleware:
    """The outermost ASGI middleware."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Time a request. Writes are logged at `info`, reads at `debug`, server errors at `error`."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start_s = time.perf_counter()
        status = HTTPStatus.INTERNAL_SERVER_ERROR.value

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, noted)
        finally:
            took_s = time.perf_counter() - start_s
            method = scope["method"] if len(scope["method"]) < 8 else "other"
            route = _route(scope)
            if not route.endswith("/events"):  # the duration of an event stream is up to its client
                self._metrics.request_s.labels(method, route, str(status)).observe(took_s)
            caller = scope.get("state", {}).get("caller")
            level = "error" if status >= 500 else "info" if method not in _READING else "debug"
            getattr(_log, level)(
                "request",
                method=method,
                path=scope["path"],
                status=status,
                took_ms=round(1000 * took_s, 1),
                caller=None if caller is None else caller.name or caller.address,
            )


def _route(scope: Scope) -> str:
    """The path with parameter names for their values, so that labels stay few; `other` if no route matched."""
    if "route" not in scope:
        return "other"
    path = str(scope["path"])
    for name, value in scope.get("path_params", {}).items():
        path = path.replace(f"/{value}", f"/{{{name}}}", 1)
    return path
