"""The application: routes, page, access, and the end of everything when the server stops."""

import hmac
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from http import HTTPStatus

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel

from spiked_service.api.captures import capture_routes
from spiked_service.api.old_schemas import DeviceOut
from spiked_service.api.page import mount_page
from spiked_service.api.problems import install, problem
from spiked_service.captures import Captures
from spiked_service.commands.version import installed_version
from spiked_service.devices import known_devices
from spiked_service.limits import Gate
from spiked_service.views import ViewRenderer

_COOKIE = "spiked_token"
_DESCRIPTION = """Captures from spike cameras, reconstructed while they run.

Poses are camera-to-world with OpenCV axes (x right, y down, z forward). Errors are RFC 9457 problem details.

```
curl -X POST localhost:8650/api/v1/captures -H 'content-type: application/json' -d '{"source": "sim:", "frames": 1280}'
curl localhost:8650/api/v1/captures/ID/trajectory?format=tum -o trajectory.tum
curl -X POST localhost:8650/api/v1/captures/ID/views -H 'content-type: application/json' \\
     -d '{"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}' -o view.png
```
"""


class Health(BaseModel):
    """Whether the service can be used."""

    status: str


def create_app(captures: Captures, devices: list[str], token: str | None) -> FastAPI:
    """The application; with a token, every request but the health checks must bring it.

    As `Authorization: Bearer TOKEN`, or once as `?token=TOKEN` from a browser, which then keeps a cookie.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await run_in_threadpool(captures.close)

    app = FastAPI(title="spiked", version=installed_version(), description=_DESCRIPTION, lifespan=lifespan)
    install(app)
    api = APIRouter(prefix="/api/v1")
    api.include_router(capture_routes(captures, ViewRenderer(Gate("views", 64))))

    @api.get("/devices", tags=["devices"])
    def list_devices() -> list[DeviceOut]:
        """What captures can be started from."""
        return [DeviceOut(**vars(device)) for device in known_devices(devices)]

    @app.get("/healthz", tags=["health"])
    async def healthz() -> Health:
        """The process answers."""
        return Health(status="ok")

    @app.get("/readyz", tags=["health"])
    async def readyz() -> Health:
        """Captures can be started."""
        return Health(status="ready")

    app.include_router(api)
    if token is not None:
        _require(app, token)
    mount_page(app)
    return app


def _require(app: FastAPI, token: str) -> None:
    @app.middleware("http")
    async def check(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        given = request.headers.get("authorization", "").removeprefix("Bearer ")
        asked = request.query_params.get("token", "")
        known = any(
            hmac.compare_digest(candidate.encode(), token.encode())
            for candidate in (given, asked, request.cookies.get(_COOKIE, ""))
        )
        if not known and request.url.path not in ("/healthz", "/readyz"):
            return problem(
                HTTPStatus.UNAUTHORIZED,
                "this service needs its token: send Authorization: Bearer TOKEN, or open /?token=TOKEN",
                {"WWW-Authenticate": "Bearer"},
            )
        response = await call_next(request)
        if known and asked:
            response.set_cookie(_COOKIE, token, httponly=True, samesite="strict")
        return response
