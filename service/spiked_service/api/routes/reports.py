"""Reports below `reconstructions/ID`: one HTML file, and a bundle with all that belongs to a result."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.routing import APIRoute

from spiked_service.api.problems import problems
from spiked_service.api.reports import Reports
from spiked_service.api.routes.parameters import BINARY, ETAG, NOT_MODIFIED, Version
from spiked_service.reconstructions.repository import ReconstructionRepository

_VERSION: dict[str, Any] = {"X-Scene-Version": {"description": "Its version.", "schema": {"type": "integer"}}}
_NAMED: dict[str, Any] = {"Content-Disposition": {"description": "With a file name.", "schema": {"type": "string"}}}
_HEADERS = {**ETAG, **_VERSION, **_NAMED}
_REPORT: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file.", "headers": _HEADERS, "content": {"text/html": {"schema": {"type": "string"}}}},
    206: {"description": "The requested range.", "content": {"text/html": {"schema": {"type": "string"}}}},
    **NOT_MODIFIED,
    **problems(404, 416),
}
_BUNDLE: dict[int | str, dict[str, Any]] = {
    200: {"description": "The archive.", "headers": _HEADERS, "content": {"application/zip": BINARY}},
    **NOT_MODIFIED,
    **problems(404, 409),
}
WithRecording = Annotated[bool, Query(description="Also put the frames of the recording into it.")]


def report_routes(rows: ReconstructionRepository, reports: Reports, route_class: type[APIRoute]) -> APIRouter:
    """Report and bundle below `reconstructions/ID`."""
    router = APIRouter(
        prefix="/reconstructions/{reconstruction_id:id}", tags=["reconstructions"], route_class=route_class
    )

    @router.get("/report", responses=_REPORT, response_class=Response)
    def get_report(reconstruction_id: str, request: Request, version: Version = None) -> Response:
        """A version as one HTML file, which opens offline: pictures, path, plots, options, machine, warnings."""
        return reports.page(request, rows.get(reconstruction_id), version)

    @router.get("/bundle", responses=_BUNDLE, response_class=Response)
    def get_bundle(
        reconstruction_id: str, request: Request, version: Version = None, recording: WithRecording = False
    ) -> Response:
        """A version as one ZIP: report, scene, trajectory as TUM, KITTI, COLMAP and nerfstudio, pictures, sidecar."""
        return reports.bundle(request, rows.get(reconstruction_id), version, recording)

    return router
