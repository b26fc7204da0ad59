"""ASGI middleware for access: tokens, origins, request sizes and rates."""

import ipaddress
import math
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request, cookie_parser
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from spiked.errors import ConfigurationError
from spiked_service.api.auth import sign_in
from spiked_service.api.auth.token_watch import while_valid
from spiked_service.api.auth.wrong_tokens import WrongTokens
from spiked_service.api.problems import problem
from spiked_service.base.limits import RateLimit
from spiked_service.events.logging import logger
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.tokens import Holder, Tokens
from spiked_service.settings.tokens import Scope as TokenScope

COOKIE = "spiked_token"
_OPEN = frozenset({"/healthz", "/readyz"})
"""Health checks, which need no token and reveal nothing about captures."""
_EVENTS = "/api/v1/events"
_ATTEMPTS = "/api/v1/attempts/"
"""Requests of agents, which bring the token of an attempt; the routes check it."""
_POLICY_VIOLATION = 1008
"""Close code for a client without the scope that it needs (RFC 6455, 7.4.1)."""
_log = logger("spiked.security")
_CHANGING = frozenset({"POST", "PUT", "PATCH", "DELETE"})
_POLICY = {
    "default-src": "'none'",
    "script-src": "'self' 'wasm-unsafe-eval'",
    "worker-src": "'self' blob:",
    "style-src": "'self'",
    "img-src": "'self' blob: data:",
    "connect-src": "'self' data: blob:",
    "font-src": "'self'",
    "manifest-src": "'self'",
    "base-uri": "'none'",
    "form-action": "'self'",
    "frame-ancestors": "'none'",
}
HEADERS = {
    "content-security-policy": "; ".join(f"{name} {value}" for name, value in _POLICY.items()),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}
"""Headers of every response. The scene viewer sorts splats in WebAssembly, in a worker created from a blob."""


@dataclass(frozen=True)
class Caller:
    """Origin of a request."""

    address: str
    name: str | None
    """Name of its token; None if no token is required."""
    scope: TokenScope = TokenScope.ADMIN
    """What its token allows; everything if no token is required."""
    token_scope: TokenScope | None = None
    """Scope of the token that it brings, whether one is required or not."""
    required: bool = False
    """Whether a token is required."""


def is_loopback(host: str) -> bool:
    """Whether the address is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Security:
    """ASGI middleware for HTTP and WebSocket. It sets `scope["state"]["caller"]`."""

    def __init__(self, app: ASGIApp, settings: ReloadableSettings, tokens: Tokens) -> None:
        self._app = app
        self._settings = settings
        self._tokens = tokens
        now = settings.now
        self._guarded = now.require_token or (now.token or now.token_file) is not None or not is_loopback(now.host)
        self._wrong = WrongTokens()
        self._rate = RateLimit(settings.now.limit_requests_per_s, settings.now.limit_requests_burst)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Reject the request, or pass it on with limits."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        request = RequestInfo(scope)
        refusal = self._refusal(request)
        if refusal is not None:
            await _refuse(refusal, scope, receive, _with_headers(send))
            return
        if request.path.startswith(_ATTEMPTS):
            scope.setdefault("state", {})["caller"] = Caller(request.address, "agent", TokenScope.OPERATE)
            await self._app(scope, self._limited(request, receive), _with_headers(send))
            return
        given = request.token()
        try:
            holder = self._holder(request, given)
        except (ConfigurationError, _TooManyGuesses) as error:
            answer = error.answer() if isinstance(error, _TooManyGuesses) else _unavailable(error)
            await _refuse(answer, scope, receive, _with_headers(send))
            return
        if request.path == sign_in.PATH or (self._guarded and holder is None and request.path not in _OPEN):
            answer = await self._sign_in(request, holder, scope, receive)
            await _refuse(answer, scope, receive, _with_headers(send))
            return
        if holder is not None and request.path == "/" and "token" in request.query:
            await _remember(request)(scope, receive, _with_headers(send))
            return
        caller = Caller(request.address, None, required=self._guarded)
        if holder is not None:
            allowed = holder.scope if self._guarded else TokenScope.ADMIN
            caller = Caller(request.address, holder.name, allowed, holder.scope, self._guarded)
        scope.setdefault("state", {})["caller"] = caller
        passed = self._app(scope, self._limited(request, receive), _with_headers(send))
        if not self._guarded or holder is None:
            await passed
        elif not await while_valid(passed, lambda: self._still_valid(given)):
            why = "its token was revoked or has expired"
            _log.info("stream ended", why=why, caller=caller.name, path=request.path)
            if request.websocket:
                await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": why})

    def _still_valid(self, token: str) -> bool:
        try:
            return self._tokens.holder_of(token) is not None
        except ConfigurationError:
            return False

    def _refusal(self, request: "RequestInfo") -> Response | None:
        settings = self._settings.now
        if not _known_host(request.host, settings.host, settings.allowed_hosts):
            return problem(
                HTTPStatus.MISDIRECTED_REQUEST,
                f"this service does not answer to the name {request.host[:100]!r}: call it by its address or as "
                "localhost, or add the name to allowed_hosts",
            )
        if request.foreign():
            return problem(HTTPStatus.FORBIDDEN, "requests from pages of other sites are refused")
        self._rate.rate, self._rate.burst = settings.limit_requests_per_s, settings.limit_requests_burst
        wait_s = self._rate.wait_s(request.address)
        if wait_s:
            return problem(
                HTTPStatus.TOO_MANY_REQUESTS,
                f"more than {settings.limit_requests_per_s:g} requests per second from {request.address}",
                {"Retry-After": str(math.ceil(wait_s))},
            )
        length = request.headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self._most(request):
            return _too_long(self._most(request))
        return None

    def _holder(self, request: "RequestInfo", given: str) -> Holder | None:
        """The holder of the token. Raises _TooManyGuesses, ConfigurationError if the tokens cannot be read."""
        holder = self._tokens.holder_of(given) if given else None
        if given and (self._guarded or request.path == sign_in.PATH) and request.path not in _OPEN:
            wait_s = self._wrong.wait_s(request.address, given, right=holder is not None)
            if wait_s:
                raise _TooManyGuesses(request.address, wait_s)
        return holder

    async def _sign_in(self, request: "RequestInfo", holder: Holder | None, scope: Scope, receive: Receive) -> Response:
        """Response without a valid token: a sign-in form for browsers, a problem for programs."""
        there = request.path == sign_in.PATH
        wanted = request.query.get("then", [""])[0] if there else request.query_without_token()
        if there and request.method == "POST":
            body = await Request(scope, self._limited(request, receive)).body()
            given = parse_qs(body.decode("latin-1")).get("token", [""])[0].strip()
            try:
                if self._holder(request, given) is not None:
                    return _cookie(RedirectResponse(sign_in.landing(wanted), HTTPStatus.SEE_OTHER), given, request)
            except _TooManyGuesses as error:
                return sign_in.form(wrong=True, wanted=wanted, wait_s=error.wait_s)
            return sign_in.form(wrong=True, wanted=wanted)
        if there and holder is not None:
            return RedirectResponse(sign_in.landing(wanted), HTTPStatus.SEE_OTHER)
        if request.method == "GET" and "text/html" in request.headers.get("accept", ""):
            return sign_in.form(wrong="token" in request.query, wanted=wanted)
        return problem(
            HTTPStatus.UNAUTHORIZED,
            "this service requires a token: send Authorization: Bearer TOKEN, or open / in a browser and enter it; "
            "`spiked token create NAME` creates one",
            {"WWW-Authenticate": "Bearer"},
        )

    def _most(self, request: "RequestInfo") -> int:
        chunk = request.method in ("PATCH", "PUT") and request.path.startswith("/api/v1/uploads/")
        return self._settings.now.limit_chunk_bytes if chunk else self._settings.now.limit_body_bytes

    def _limited(self, request: "RequestInfo", receive: Receive) -> Receive:
        """Count the bytes of the body while it is received, because its length is not always given."""
        most, seen = self._most(request), 0

        async def counted() -> Message:
            nonlocal seen
            message = await receive()
            if message["type"] == "http.request":
                seen += len(message.get("body", b""))
                if seen > most:
                    raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, _too_long_text(most))
            return message

        return counted


class _TooManyGuesses(Exception):
    """Too many different wrong tokens from one address."""

    def __init__(self, address: str, wait_s: float) -> None:
        super().__init__(address)
        self.address = address
        self.wait_s = wait_s

    def answer(self) -> Response:
        return problem(
            HTTPStatus.TOO_MANY_REQUESTS,
            f"too many wrong tokens from {self.address}; wait, then send the right one",
            {"Retry-After": str(math.ceil(self.wait_s))},
        )


class RequestInfo:
    """Headers and address of a request."""

    def __init__(self, scope: Scope) -> None:
        self.headers = Headers(scope=scope)
        self.path: str = scope["path"]
        self.method: str = scope.get("method", "GET")
        self.websocket = scope["type"] == "websocket"
        self.secure = scope["scheme"] in ("https", "wss")
        self.host = self.headers.get("host", "")
        self.address: str = scope["client"][0] if scope.get("client") else "unknown"
        self.query: dict[str, list[str]] = parse_qs(scope.get("query_string", b"").decode("latin-1"))

    def token(self) -> str:
        """Token from the header, the cookie, or the query where a browser cannot set a header."""
        kind, _, given = self.headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and given:
            return given.strip()
        if self.path in ("/", _EVENTS) and "token" in self.query:
            return self.query["token"][0]
        return str(cookie_parser(self.headers.get("cookie", "")).get(COOKIE, ""))

    def query_without_token(self) -> str:
        """The query string without the token."""
        return urlencode({name: values for name, values in self.query.items() if name != "token"}, doseq=True)

    def foreign(self) -> bool:
        """Whether a page of another site makes a browser send a request that only the service's page may send."""
        if self.method not in _CHANGING and not self.websocket:
            return False
        if self.headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return True
        origin = self.headers.get("origin")
        return origin is not None and urlsplit(origin).netloc.lower() != self.host.lower()


def _known_host(given: str, own: str, allowed: list[str]) -> bool:
    """Whether the Host header is an IP address, which DNS rebinding cannot change, or an allowed name."""
    name = urlsplit(f"//{given}").hostname if _sound(given) else None
    if name is None:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        known = {"localhost", own.lower(), *(host.lower() for host in allowed)}
        return name in known or name.endswith(".localhost")
    return True


def _sound(host: str) -> bool:
    try:
        split = urlsplit(f"//{host}")
        return bool(split.hostname) and split.netloc == host and "@" not in host and split.port != 0
    except ValueError:
        return False


def _unavailable(error: Exception) -> Response:
    return problem(HTTPStatus.SERVICE_UNAVAILABLE, str(error))


def _too_long_text(most: int) -> str:
    return f"the body may have at most {most} bytes; send less, or raise the limit in the settings"


def _too_long(most: int) -> Response:
    return problem(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, _too_long_text(most))


def _cookie(response: Response, token: str, request: RequestInfo) -> Response:
    response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=request.secure)
    return response


def _remember(request: RequestInfo) -> Response:
    """Move the token from the URL into a cookie."""
    there = sign_in.landing(request.query_without_token())
    return _cookie(RedirectResponse(there, HTTPStatus.SEE_OTHER), request.query["token"][0], request)


async def _refuse(answer: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Respond over HTTP, also to a WebSocket request."""
    if scope["type"] == "http":
        await answer(scope, receive, send)
        return

    async def denied(message: MutableMapping[str, Any]) -> None:
        await send({**message, "type": f"websocket.{message['type']}"})

    await receive()
    await answer({**scope, "type": "http", "method": "GET"}, receive, denied)


def _with_headers(send: Send) -> Callable[[Message], Awaitable[None]]:
    async def with_headers(message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return with_headers
