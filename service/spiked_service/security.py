"""What every request passes before it reaches a route: whose it is, where from, how much, how often."""

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
from spiked_service import sign_in
from spiked_service.api.problems import problem
from spiked_service.limits import RateLimit
from spiked_service.live import LiveSettings
from spiked_service.tokens import Tokens

COOKIE = "spiked_token"
_OPEN = frozenset({"/healthz", "/readyz"})
"""A supervisor asks these without a token; they tell nothing about anybody."""
_EVENTS = "/api/v1/events"
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
"""Of every answer. The scene viewer sorts its splats in WebAssembly, in a worker made from a blob."""


@dataclass(frozen=True)
class Caller:
    """Whom a request comes from."""

    address: str
    name: str | None
    """Of its token; None where none was needed."""


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a service that listens there."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Security:
    """ASGI middleware for HTTP and WebSocket alike. `scope["state"]["caller"]` says who asks."""

    def __init__(self, app: ASGIApp, settings: LiveSettings, tokens: Tokens) -> None:
        self._app = app
        self._settings = settings
        self._tokens = tokens
        now = settings.now
        self._guarded = now.require_token or now.token is not None or not is_loopback(now.host)
        self._rate = RateLimit(settings.now.limit_requests_per_s, settings.now.limit_requests_burst)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse, or pass on with the limits in place."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        request = _Asked(scope)
        refusal = self._refusal(request)
        if refusal is not None:
            await _refuse(refusal, scope, receive, _with_headers(send))
            return
        try:
            name = self._name(request)
        except ConfigurationError as error:
            await _refuse(problem(HTTPStatus.SERVICE_UNAVAILABLE, str(error)), scope, receive, _with_headers(send))
            return
        if self._guarded and (name is None or request.path == sign_in.PATH) and request.path not in _OPEN:
            answer = await self._sign_in(request, name, scope, receive)
            await _refuse(answer, scope, receive, _with_headers(send))
            return
        if name is not None and request.path == "/" and "token" in request.query:
            await _remember(request)(scope, receive, _with_headers(send))
            return
        scope.setdefault("state", {})["caller"] = Caller(request.address, name)
        await self._app(scope, self._limited(request, receive), _with_headers(send))

    def _refusal(self, request: "_Asked") -> Response | None:
        settings = self._settings.now
        if not _known_host(request.host, settings.host, settings.allowed_hosts):
            return problem(
                HTTPStatus.MISDIRECTED_REQUEST,
                f"this service does not answer to the name {request.host[:100]!r}: call it by its address or as "
                "localhost, or add the name to allowed_hosts",
            )
        if request.foreign():
            return problem(HTTPStatus.FORBIDDEN, "requests that pages of other sites make are refused")
        self._rate.rate, self._rate.burst = settings.limit_requests_per_s, settings.limit_requests_burst
        wait_s = self._rate.wait_s(request.address)
        if wait_s:
            return problem(
                HTTPStatus.TOO_MANY_REQUESTS,
                f"more than {settings.limit_requests_per_s:g} requests a second from {request.address}; ask less often",
                {"Retry-After": str(math.ceil(wait_s))},
            )
        length = request.headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self._most(request):
            return _too_long(self._most(request))
        return None

    def _name(self, request: "_Asked") -> str | None:
        given = request.token()
        return self._tokens.name_of(given) if given else None

    async def _sign_in(self, request: "_Asked", name: str | None, scope: Scope, receive: Receive) -> Response:
        """The answer to somebody without a token: a form for people, a problem for programs."""
        there = request.path == sign_in.PATH
        wanted = request.query.get("then", [""])[0] if there else request.query_without_token()
        if there and request.method == "POST":
            body = await Request(scope, self._limited(request, receive)).body()
            given = parse_qs(body.decode("latin-1")).get("token", [""])[0].strip()
            if self._tokens.name_of(given) is not None:
                return _cookie(RedirectResponse(sign_in.landing(wanted), HTTPStatus.SEE_OTHER), given, request)
            return sign_in.form(wrong=True, wanted=wanted)
        if there and name is not None:
            return RedirectResponse(sign_in.landing(wanted), HTTPStatus.SEE_OTHER)
        if request.method == "GET" and "text/html" in request.headers.get("accept", ""):
            return sign_in.form(wrong="token" in request.query, wanted=wanted)
        return problem(
            HTTPStatus.UNAUTHORIZED,
            "this service needs a token: send Authorization: Bearer TOKEN, or open / in a browser and enter it; "
            "`spiked token create NAME` makes one",
            {"WWW-Authenticate": "Bearer"},
        )

    def _most(self, request: "_Asked") -> int:
        chunk = request.method == "PATCH" and request.path.startswith("/api/v1/uploads/")
        return self._settings.now.limit_chunk_bytes if chunk else self._settings.now.limit_body_bytes

    def _limited(self, request: "_Asked", receive: Receive) -> Receive:
        """A body without a length is counted while it comes."""
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


class _Asked:
    """What a request says of itself."""

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
        """From the header, the cookie, or, where a browser can do no other, the address."""
        kind, _, given = self.headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and given:
            return given.strip()
        if self.path in ("/", _EVENTS) and "token" in self.query:
            return self.query["token"][0]
        return str(cookie_parser(self.headers.get("cookie", "")).get(COOKIE, ""))

    def query_without_token(self) -> str:
        """What of the address may be kept."""
        return urlencode({name: values for name, values in self.query.items() if name != "token"}, doseq=True)

    def foreign(self) -> bool:
        """Whether a page of another site makes a browser ask for what only our own page may."""
        if self.method not in _CHANGING and not self.websocket:
            return False
        if self.headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return True
        origin = self.headers.get("origin")
        return origin is not None and urlsplit(origin).netloc.lower() != self.host.lower()


def _known_host(given: str, own: str, allowed: list[str]) -> bool:
    """An address cannot be pointed elsewhere by somebody's name server, a name can."""
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


def _too_long_text(most: int) -> str:
    return f"the body of this request may have {most} bytes; send less, or raise the limit in the settings"


def _too_long(most: int) -> Response:
    return problem(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, _too_long_text(most))


def _cookie(response: Response, token: str, request: _Asked) -> Response:
    response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=request.secure)
    return response


def _remember(request: _Asked) -> Response:
    """Keep the token in a cookie and take it out of the address."""
    there = sign_in.landing(request.query_without_token())
    return _cookie(RedirectResponse(there, HTTPStatus.SEE_OTHER), request.query["token"][0], request)


async def _refuse(answer: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer over HTTP, also where a WebSocket was asked for."""
    if scope["type"] == "http":
        await answer(scope, receive, send)
        return

    async def denied(message: MutableMapping[str, Any]) -> None:
        await send({**message, "type": f"websocket.{message['type']}"})

    await receive()
    await answer({**scope, "type": "http", "method": "GET"}, receive, denied)


def _with_headers(send: Send) -> Callable[[Message], Awaitable[None]]:
    async def told(message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return told
