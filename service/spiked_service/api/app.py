"""The application: routes, page, access, and the end of everything when the server stops."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import APIRouter, FastAPI
from fastapi.concurrency import run_in_threadpool

from spiked_service.api.captures import capture_routes
from spiked_service.api.devices import DeviceWatch, device_routes
from spiked_service.api.docs import mount_docs
from spiked_service.api.doctor import doctor_routes
from spiked_service.api.events import event_routes
from spiked_service.api.idempotency import IdempotencyKeys, idempotent
from spiked_service.api.observe import Observe
from spiked_service.api.openapi import describe
from spiked_service.api.operations import health_routes, metrics_routes, operations_routes
from spiked_service.api.options import option_routes
from spiked_service.api.page import mount_page
from spiked_service.api.paths import register_path_kinds
from spiked_service.api.problems import install
from spiked_service.api.reconstructions import Results, reconstruction_routes
from spiked_service.api.services import Services
from spiked_service.api.sources import Sources
from spiked_service.api.uploads import upload_routes
from spiked_service.commands.version import installed_version
from spiked_service.security import Security
from spiked_service.uploads import Uploads
from spiked_service.views import ViewRenderer


def create_app(services: Services) -> FastAPI:
    """The application. Where tokens are needed, every request but the health checks must bring one."""

    sources = Sources(services.settings)
    watch = DeviceWatch(services.captures, sources, services.bus)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        watch.start()
        yield
        await run_in_threadpool(watch.stop)
        await run_in_threadpool(services.captures.close)

    app = FastAPI(title="spiked", version=installed_version(), docs_url=None, redoc_url=None, lifespan=lifespan)
    describe(app)
    install(app)
    app.include_router(_api(services, sources))
    app.include_router(health_routes(services))
    app.include_router(metrics_routes(services))
    app.add_middleware(Security, settings=services.settings, tokens=services.tokens)
    app.add_middleware(Observe, metrics=services.metrics)  # the last one added is the outermost
    mount_docs(app)
    mount_page(app)
    return app


def _api(services: Services, sources: Sources) -> APIRouter:
    register_path_kinds()
    captures, reconstructions, keeping = services.captures, services.reconstructions, services.keeping
    once = idempotent(IdempotencyKeys(keeping.catalogue))
    views = ViewRenderer(services.renders)
    results = Results(reconstructions, captures)
    uploads = Uploads(keeping.folder, keeping.catalogue, lambda: services.settings.now.limit_upload_bytes)
    api = APIRouter(prefix="/api/v1")
    api.include_router(device_routes(captures, sources, once))
    api.include_router(capture_routes(captures, sources, keeping.folder, results, views, once))
    api.include_router(reconstruction_routes(reconstructions, results, views, once))
    api.include_router(doctor_routes(keeping.folder.path))
    api.include_router(option_routes())
    api.include_router(upload_routes(uploads, captures, once))
    api.include_router(event_routes(services.bus, services.event_clients))
    api.include_router(operations_routes(services))
    return api
