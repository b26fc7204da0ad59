"""The ASGI application: routes, page and middleware."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import APIRouter, Depends, FastAPI
from fastapi.concurrency import run_in_threadpool

from spiked_service.api.access_log import AccessLogMiddleware
from spiked_service.api.auth.scopes import authorise
from spiked_service.api.auth.security import Security
from spiked_service.api.exports import Exports
from spiked_service.api.head import Head
from spiked_service.api.idempotency import idempotent
from spiked_service.api.openapi import describe
from spiked_service.api.paths import register_path_kinds
from spiked_service.api.problems import install
from spiked_service.api.reports import Reports
from spiked_service.api.routes.attempts import attempt_routes
from spiked_service.api.routes.captures import capture_routes
from spiked_service.api.routes.cleaning import cleaning_routes
from spiked_service.api.routes.configuration import configuration_routes
from spiked_service.api.routes.devices import device_routes
from spiked_service.api.routes.docs import mount_docs
from spiked_service.api.routes.doctor import doctor_routes
from spiked_service.api.routes.events import event_routes
from spiked_service.api.routes.exports import export_routes
from spiked_service.api.routes.groups import group_routes
from spiked_service.api.routes.guide import mount_guide
from spiked_service.api.routes.health import health_routes, metrics_routes
from spiked_service.api.routes.maps import map_routes
from spiked_service.api.routes.options import option_routes
from spiked_service.api.routes.page import mount_page
from spiked_service.api.routes.previews import preview_routes
from spiked_service.api.routes.reconstructions import reconstruction_record_routes, reconstruction_routes
from spiked_service.api.routes.recordings import recording_routes
from spiked_service.api.routes.reports import report_routes
from spiked_service.api.routes.results import capture_result_routes, reconstruction_result_routes
from spiked_service.api.routes.scale import scale_routes
from spiked_service.api.routes.system import system_routes
from spiked_service.api.routes.uploads import upload_routes
from spiked_service.api.services import Services
from spiked_service.base.version import installed_version
from spiked_service.captures.camera_profiles import CameraProfiles


def create_app(services: Services) -> FastAPI:
    """Create the application. If tokens are required, all requests but health checks need one."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        services.device_watch.start()
        yield
        await run_in_threadpool(services.device_watch.stop)
        await run_in_threadpool(services.captures.close)

    app = FastAPI(title="spiked", version=installed_version(), docs_url=None, redoc_url=None, lifespan=lifespan)
    describe(app)
    install(app)
    app.include_router(_api(services))
    app.include_router(health_routes(services.health))
    app.include_router(metrics_routes(services.metrics))
    app.add_middleware(Head)  # inside of the others: what is logged and refused is a HEAD
    app.add_middleware(Security, settings=services.settings, tokens=services.tokens)
    app.add_middleware(AccessLogMiddleware, metrics=services.metrics)  # the last one added is the outermost
    mount_docs(app)
    mount_guide(app)
    mount_page(app)
    return app


def _api(services: Services) -> APIRouter:
    """The routes below `/api/v1`. Plain functions among them run on threads."""
    register_path_kinds()
    captures, reconstructions, folder = services.captures, services.reconstructions, services.folder
    results, views = services.results, services.views
    profiles = CameraProfiles(folder.profiles)
    once = idempotent(services.idempotency_keys)
    api = APIRouter(prefix="/api/v1", dependencies=[Depends(authorise)])
    api.include_router(device_routes(captures, services.sources, folder, once))
    api.include_router(capture_routes(captures, services.sources, once))
    api.include_router(group_routes(captures, services.sources, once))
    api.include_router(recording_routes(captures, folder, once))
    api.include_router(preview_routes(captures, folder, results, views, once))
    api.include_router(capture_result_routes(results, views, once))
    api.include_router(reconstruction_routes(reconstructions, services.sources, profiles, once))
    api.include_router(map_routes(reconstructions, results, once))
    api.include_router(reconstruction_result_routes(reconstructions.rows, results, views, once))
    api.include_router(report_routes(reconstructions.rows, Reports(results, captures, folder, views), once))
    api.include_router(export_routes(reconstructions.rows, results, Exports(results, captures, folder), once))
    api.include_router(cleaning_routes(reconstructions.rows, results, once))
    api.include_router(scale_routes(reconstructions.rows, results, captures, once))
    api.include_router(reconstruction_record_routes(reconstructions.rows, once))
    api.include_router(attempt_routes(services.cluster))
    api.include_router(doctor_routes(folder.path, captures))
    api.include_router(option_routes())
    api.include_router(upload_routes(services.uploads, captures, services.sources, profiles, once))
    api.include_router(event_routes(services.bus, services.event_clients))
    api.include_router(system_routes(services))
    api.include_router(configuration_routes(services.settings, services.tokens))
    return api
