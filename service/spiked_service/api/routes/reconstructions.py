"""Reconstructions: start, list, cancel, restart and remove them; their versions, timeline and log."""

from http import HTTPStatus
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import PlainTextResponse
from fastapi.routing import APIRoute

from spiked.errors import ConfigurationError
from spiked_service.api import files
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import problems
from spiked_service.api.routes.parameters import FromS, ToS
from spiked_service.api.schemas.base import IN_DIGITS, Cursor, Limit
from spiked_service.api.schemas.reconstructions import (
    ClosureOut,
    GapOut,
    ReconstructionChange,
    ReconstructionOut,
    ReconstructionPage,
    ReconstructionRequest,
    RestartRequest,
    TimelineOut,
    VersionOut,
    VersionsOut,
    WorkOut,
)
from spiked_service.api.sources import Sources
from spiked_service.captures.camera_profiles import CameraProfiles
from spiked_service.reconstructions.given import Given
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.timeline import STATES, Timeline, Timelines, known
from spiked_service.results.versions import versions
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import JobState, ReconstructionRow, Task

Points = Annotated[
    int | None,
    Query(ge=1, le=100_000, description="Most points: neighbours are joined. Default: every tracked view."),
    IN_DIGITS,
]
_LOG_BYTES = 1 << 20
"""The log is shown from this many bytes before its end."""


def reconstruction_routes(
    reconstructions: Reconstructions, sources: Sources, profiles: CameraProfiles, route_class: type[APIRoute]
) -> APIRouter:
    """Routes below `reconstructions`."""
    router = APIRouter(prefix="/reconstructions", tags=["reconstructions"], route_class=route_class)

    @router.post("", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409, 507))
    def start_reconstruction(
        body: ReconstructionRequest, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> ReconstructionOut:
        """Queue a reconstruction of a recording; live captures precede the queue. With `map` it extends that map."""
        task, map_ids = (Task.RECONSTRUCT, ()) if body.map is None else (Task.EXTEND, (body.map,))
        given = _given(body, sources, profiles)
        row = reconstructions.submit(
            body.capture_id,
            body.options,
            body.priority,
            task=task,
            map_ids=map_ids,
            given=given,
            user=user_of(request),
        )
        return accepted(row, request, response)

    _add_reading_routes(router, reconstructions.rows)

    @router.patch("/{reconstruction_id:id}", responses=problems(404, 409, 507))
    def change_reconstruction(reconstruction_id: str, body: ReconstructionChange) -> ReconstructionOut:
        """Change its name or notes, hold it in the queue, or move it there.

        One that runs returns to the queue within a second when it is held, and goes on from its checkpoint later.
        """
        row = reconstructions.change(
            reconstruction_id, name=body.name, notes=body.notes, held=body.held, queue_place=body.queue_place
        )
        return ReconstructionOut.of(row)

    _add_end_routes(router, reconstructions)
    return router


def _add_reading_routes(router: APIRouter, rows: ReconstructionRepository) -> None:
    """Routes that list reconstructions and give one."""

    @router.get("", responses=problems(404))
    def list_reconstructions(
        limit: Limit = 50,
        cursor: Cursor = None,
        capture_id: Annotated[str | None, Query(min_length=1, max_length=64)] = None,
        state: JobState | None = None,
        in_turn: Annotated[
            bool, Query(description="List the whole queue instead, the next to begin first, and count it.")
        ] = False,
        shown_of: Annotated[
            list[str] | None,
            Query(
                max_length=100,
                description="List of each of these captures the reconstruction whose scene is shown: the newest with a "
                "version, else the newest that may get one.",
            ),
        ] = None,
    ) -> ReconstructionPage:
        """Reconstructions, newest first, or the queue in its order."""
        if shown_of is not None:
            if in_turn or (capture_id, state, cursor) != (None, None, None):
                raise ConfigurationError("shown_of lists what it names: leave out the other filters")
            shown = [ReconstructionOut.of(row) for row in rows.shown_of(shown_of)]
            return ReconstructionPage(items=shown, next_cursor=None, total=None)
        if in_turn and (capture_id is not None or state not in (None, JobState.QUEUED)):
            raise ConfigurationError("in_turn lists the whole queue: leave out capture_id and state")
        page = rows.in_turn(limit, cursor) if in_turn else rows.page(limit, cursor, capture_id, state)
        items = [ReconstructionOut.of(row) for row in page.items]
        return ReconstructionPage(items=items, next_cursor=page.next_cursor, total=page.total)

    @router.get("/{reconstruction_id:id}", responses=problems(404))
    def get_reconstruction(reconstruction_id: str) -> ReconstructionOut:
        """State and progress of a reconstruction."""
        return ReconstructionOut.of(rows.get(reconstruction_id))


def calibration_of(device_id: str, sources: Sources, profiles: CameraProfiles) -> Path:
    """The calibration of a device. Raises UnknownIdError without one."""
    device = next((one for one in sources.devices() if one.source == device_id), None)
    path = None if device is None else profiles.calibration(device)
    if path is None:
        raise UnknownIdError(f"there is no device {device_id} with a calibration; POST profile:calibrate makes one")
    return path


def _add_end_routes(router: APIRouter, reconstructions: Reconstructions) -> None:
    """Routes that cancel, restart and remove a reconstruction."""
    rows = reconstructions.rows

    @router.post("/{reconstruction_id:id}:cancel", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def cancel_reconstruction(reconstruction_id: str, idempotency_key: IdempotencyKey = None) -> ReconstructionOut:
        """End it; published versions are kept."""
        reconstructions.cancel(reconstruction_id)
        return ReconstructionOut.of(rows.get(reconstruction_id))

    @router.post("/{reconstruction_id:id}:restart", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409, 507))
    def restart_reconstruction(
        reconstruction_id: str, body: RestartRequest | None = None, idempotency_key: IdempotencyKey = None
    ) -> ReconstructionOut:
        """Restart it from the recording, with new options if given; version numbers continue."""
        reconstructions.restart(reconstruction_id, None if body is None else body.options)
        return ReconstructionOut.of(rows.get(reconstruction_id))

    @router.delete("/{reconstruction_id:id}", status_code=HTTPStatus.NO_CONTENT, responses=problems(404, 409))
    def remove_reconstruction(reconstruction_id: str) -> None:
        """Delete it with its published versions."""
        reconstructions.remove(reconstruction_id)


def _given(body: ReconstructionRequest, sources: Sources, profiles: CameraProfiles) -> Given:
    device = body.calibration_of
    return Given(
        poses=body.poses,
        poses_of=body.poses_of,
        calibration_of=device or "",
        calibration=None if device is None else calibration_of(device, sources, profiles),
    )


def user_of(request: Request) -> str:
    """Who asks, by the name of the token."""
    return request.state.caller.name or ""


def accepted(row: ReconstructionRow, request: Request, response: Response) -> ReconstructionOut:
    """The answer to the request for a new job."""
    response.headers["Location"] = request.url_for("get_reconstruction", reconstruction_id=row.id).path
    return ReconstructionOut.of(row)


def reconstruction_record_routes(rows: ReconstructionRepository, route_class: type[APIRoute]) -> APIRouter:
    """Versions, timeline and log below `reconstructions/ID`."""
    timelines = Timelines()
    router = APIRouter(
        prefix="/reconstructions/{reconstruction_id:id}", tags=["reconstructions"], route_class=route_class
    )

    @router.get("/versions", responses=problems(404))
    def list_versions(reconstruction_id: str) -> VersionsOut:
        """Available versions, oldest first."""
        published = {one.version: one for one in versions(rows.folder(reconstruction_id))}
        found = rows.versions(reconstruction_id)
        return VersionsOut(items=[VersionOut.of(row, published.get(row.version)) for row in found])

    @router.get("/timeline", responses=problems(404))
    def get_timeline(
        reconstruction_id: str, from_s: FromS = None, to_s: ToS = None, points: Points = None
    ) -> TimelineOut:
        """Timeline: state, fit and loss over the frames, and closed loops; a part of it, at most so many points."""
        timeline = timelines.read(rows.timeline(reconstruction_id)).between(from_s, to_s)
        return _timeline(timeline if points is None else timeline.reduced(points))

    @router.get("/log", responses=problems(404), response_class=PlainTextResponse)
    def get_log(reconstruction_id: str, request: Request) -> Response:
        """The end of its log, as text."""
        path = rows.log(reconstruction_id)
        if not path.exists():
            return PlainTextResponse("")
        stamp = files.stamp(path)
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _LOG_BYTES))
            text = file.read(_LOG_BYTES).decode(errors="replace")
        return files.content(request, text.encode(), "text/plain; charset=utf-8", files.etag("log", stamp))

    return router


def _timeline(timeline: Timeline) -> TimelineOut:
    moments = timeline.moments
    values = {name: known(moments[name].tolist()) for name in ("chi2", "sigma_px", "rate", "loss", "psnr_db", "work_s")}
    return TimelineOut(
        time_s=moments["time_s"].tolist(),
        frame=moments["frame"].tolist(),
        state=[STATES[one] for one in moments["state"]],
        splats=[None if one is None else int(one) for one in known(moments["splats"].tolist())],
        work=WorkOut(
            work_s=[one.work_s for one in timeline.progress],
            loss=[one.loss for one in timeline.progress],
            psnr_db=[one.psnr_db for one in timeline.progress],
            splats=[one.splats for one in timeline.progress],
        ),
        gaps=[GapOut(first=gap.first, count=gap.count, cause=gap.cause) for gap in timeline.gaps],
        closures=[ClosureOut(earlier_s=one.earlier_s, later_s=one.later_s) for one in timeline.closures],
        **values,
    )
