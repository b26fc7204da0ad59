"""The application: routes, page, access, and the end of everything when the server stops."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import APIRouter, FastAPI
from fastapi.concurrency import run_in_threadpool

from spiked_service.api.captures import capture_routes
from spiked_service.api.docs import mount_docs
from spiked_service.api.events import event_routes
from spiked_service.api.observe import Observe
from spiked_service.api.old_schemas import DeviceOut
from spiked_service.api.openapi import describe
from spiked_service.api.operations import health_routes, metrics_routes, operations_routes
from spiked_service.api.page import mount_page
from spiked_service.api.problems import install
from spiked_service.api.services import Services
from spiked_service.commands.version import installed_version
from spiked_service.devices import known_devices
from spiked_service.security import Security
from spiked_service.views import ViewRenderer


def create_app(services: Services) -> FastAPI:
    """The application. Where tokens are needed, every request but the health checks must bring one."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await run_in_threadpool(services.captures.close)

    app = FastAPI(title="spiked", version=installed_version(), docs_url=None, redoc_url=None, lifespan=lifespan)
    describe(app)
    install(app)
    api = APIRouter(prefix="/api/v1")
    api.include_router(capture_routes(services.captures, services.reconstructions, ViewRenderer(services.renders)))
    api.include_router(event_routes(services.bus, services.event_clients))
    api.include_router(operations_routes(services))

    @api.get("/devices", tags=["devices"])
    def list_devices() -> list[DeviceOut]:
        """What captures can be started from."""
        return [DeviceOut(**vars(device)) for device in known_devices(services.settings.now.devices)]

    app.include_router(api)
    app.include_router(health_routes(services))
    app.include_router(metrics_routes(services))
    app.add_middleware(Security, settings=services.settings, tokens=services.tokens)
    mount_docs(app)
    app.add_middleware(Observe, metrics=services.metrics)  # the last one added is the outermost
    mount_page(app)
    return app
