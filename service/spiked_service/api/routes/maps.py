"""Maps: localise a recording in the map of a reconstruction, merge two maps, and what was found."""

from http import HTTPStatus
from pathlib import Path

from fastapi import APIRouter, Request, Response
from fastapi.routing import APIRoute

from spiked_service.api import files
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import NothingError, NotReadyError, problems
from spiked_service.api.results import Results
from spiked_service.api.routes.parameters import NOT_MODIFIED, Version
from spiked_service.api.routes.reconstructions import accepted, user_of
from spiked_service.api.schemas.reconstructions import (
    LocalisationOut,
    LocaliseRequest,
    MergeRequest,
    PathOut,
    PathsOut,
    ReconstructionOut,
    RegistrationOut,
)
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.results.map_reports import LOCALISATION, REGISTRATION
from spiked_service.settings.reconstruction_options import IntrinsicsOption, ReconstructionOptions
from spiked_service.store.rows import ReconstructionRow, Task


def map_routes(reconstructions: Reconstructions, results: Results, route_class: type[APIRoute]) -> APIRouter:
    """Routes below `reconstructions/ID` that use it as a map."""
    rows = reconstructions.rows
    router = APIRouter(
        prefix="/reconstructions/{reconstruction_id:id}", tags=["reconstructions"], route_class=route_class
    )

    @router.post(":localise", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409, 507))
    def localise(
        reconstruction_id: str,
        body: LocaliseRequest,
        request: Request,
        response: Response,
        idempotency_key: IdempotencyKey = None,
    ) -> ReconstructionOut:
        """Queue the search for the camera of a recording, or of a part of it, in its map.

        The result has the scene of the map, and as trajectory the path of the recording in it.
        """
        lens = None if body.intrinsics is None else IntrinsicsOption(**body.intrinsics.model_dump())
        options = ReconstructionOptions(intrinsics=lens, threads=body.threads)
        row = reconstructions.submit(
            body.capture_id,
            options,
            body.priority,
            task=Task.LOCALISE,
            map_ids=(reconstruction_id,),
            part=body.part(),
            user=user_of(request),
        )
        return accepted(row, request, response)

    @router.post(":merge", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409, 507))
    def merge(
        reconstruction_id: str,
        body: MergeRequest,
        request: Request,
        response: Response,
        idempotency_key: IdempotencyKey = None,
    ) -> ReconstructionOut:
        """Queue one map of it and another reconstruction of the same place, in its frame of reference and unit.

        The result is a new reconstruction of its capture; both stay as they are. Recordings are not needed.
        """
        capture_id, user = rows.get(reconstruction_id).capture_id, user_of(request)
        options, map_ids = ReconstructionOptions(seed=body.seed, threads=body.threads), (reconstruction_id, body.other)
        row = reconstructions.submit(capture_id, options, body.priority, task=Task.MERGE, map_ids=map_ids, user=user)
        return accepted(row, request, response)

    @router.get("/paths", responses=problems(404))
    def list_paths(reconstruction_id: str, version: Version = None) -> PathsOut:
        """The paths of all recordings through the scene of a version, its own first."""
        row = rows.get(reconstruction_id)
        published = results.of(row, version).published
        own = PathOut(path=0, capture_id=row.capture_id, poses=published.poses)
        others = [
            PathOut(path=number, capture_id=one.capture_id, poses=one.poses)
            for number, one in enumerate(published.paths, 1)
        ]
        return PathsOut(version=published.version, items=[own, *others])

    @router.get(
        "/localisation",
        responses={**NOT_MODIFIED, **problems(404)},
        response_model=LocalisationOut,
        response_class=Response,
    )
    def get_localisation(reconstruction_id: str, request: Request) -> Response:
        """Of a localisation: whether the map was recognised, and the pose of each window of frames."""
        row = rows.get(reconstruction_id)
        return _report(request, row, rows.folder(row.id), LOCALISATION, row.task is Task.LOCALISE)

    @router.get(
        "/registration",
        responses={**NOT_MODIFIED, **problems(404)},
        response_model=RegistrationOut,
        response_class=Response,
    )
    def get_registration(reconstruction_id: str, request: Request) -> Response:
        """Of an extended or merged map: how the two were brought together, and how well they agree."""
        row = rows.get(reconstruction_id)
        return _report(request, row, rows.folder(row.id), REGISTRATION, row.task in (Task.EXTEND, Task.MERGE))

    return router


def _report(request: Request, row: ReconstructionRow, folder: Path, name: str, has_one: bool) -> Response:
    path = folder / name
    if not has_one:
        raise NothingError(f"reconstruction {row.id} has the task {row.task}: there is no {path.stem} of it")
    if not path.exists():
        if row.state.over:
            raise NothingError(f"{row.id} is {row.state} and has no {path.stem}; :restart begins it again")
        raise NotReadyError(f"reconstruction {row.id} has no {path.stem} yet; it is at stage {row.stage}")
    stamp = files.stamp(path)
    return files.content(request, path.read_bytes(), "application/json", files.etag(path.stem, stamp))
