"""Groups: captures on several devices that start together, and the offsets of their clocks."""

from collections.abc import Sequence
from http import HTTPStatus

from fastapi import APIRouter, Request, Response
from fastapi.routing import APIRoute

from spiked.errors import RecordingError
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import problems
from spiked_service.api.routes.captures import plan_of
from spiked_service.api.schemas.captures import CaptureOut
from spiked_service.api.schemas.groups import GroupOut, GroupRequest, OffsetOut
from spiked_service.api.sources import Sources
from spiked_service.captures.captures import Captures
from spiked_service.captures.clock_offset import clock_offset
from spiked_service.store.snapshot import Snapshot


def group_routes(captures: Captures, sources: Sources, route_class: type[APIRoute]) -> APIRouter:
    """Routes below `groups`."""
    router = APIRouter(prefix="/groups", tags=["captures"], route_class=route_class)

    @router.post("", status_code=HTTPStatus.CREATED, responses=problems(404, 409, 507))
    def start_group(
        body: GroupRequest, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> GroupOut:
        """Start captures on several devices together, or none: the answer says which cannot start and why."""
        group_id = captures.start_group([plan_of(one, sources) for one in body.captures])
        response.headers["Location"] = request.url_for("get_group", group_id=group_id).path
        return _group(captures, group_id)

    @router.get("/{group_id:id}", responses=problems(404))
    def get_group(group_id: str) -> GroupOut:
        """Its captures and, when all have ended, the offset of each against the first."""
        return _group(captures, group_id)

    @router.post("/{group_id:id}:stop", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def stop_group(group_id: str, idempotency_key: IdempotencyKey = None) -> GroupOut:
        """End the acquisition of all its captures, as `captures/ID:stop` does."""
        for one in captures.group(group_id):
            captures.stop(one.row.id)
        return _group(captures, group_id)

    return router


def _group(captures: Captures, group_id: str) -> GroupOut:
    members = captures.group(group_id)
    over = all(one.row.state.over for one in members)
    return GroupOut(
        id=group_id,
        captures=[CaptureOut.of(one) for one in members],
        offsets=_offsets(captures, members) if over else None,
    )


def _offsets(captures: Captures, members: Sequence[Snapshot]) -> list[OffsetOut]:
    return [_offset(captures, members[0].row.id, one.row.id) for one in members[1:]]


def _offset(captures: Captures, first_id: str, capture_id: str) -> OffsetOut:
    try:
        found = clock_offset(captures, first_id, capture_id)
    except RecordingError as error:
        return OffsetOut(capture_id=capture_id, offset_s=None, sigma_s=None, reason=str(error))
    return OffsetOut(capture_id=capture_id, offset_s=found.seconds, sigma_s=found.sigma_s, reason="")
