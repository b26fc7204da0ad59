"""Captures: start, list, change, stop and remove them."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.routing import APIRoute

from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import problems
from spiked_service.api.schemas.base import Cursor, Limit
from spiked_service.api.schemas.captures import CaptureChange, CaptureOut, CapturePage, CaptureRequest
from spiked_service.api.sources import Sources
from spiked_service.base.errors import BusyError
from spiked_service.captures.captures import Captures
from spiked_service.store.capture_listing import CaptureFilter, CaptureSort
from spiked_service.store.rows import CaptureState, Grade, Plan


def capture_routes(captures: Captures, sources: Sources, route_class: type[APIRoute]) -> APIRouter:
    """Routes below `captures`."""
    router = APIRouter(prefix="/captures", tags=["captures"], route_class=route_class)

    @router.post("", status_code=HTTPStatus.CREATED, responses=problems(404, 409, 507))
    def start_capture(
        body: CaptureRequest, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> CaptureOut:
        """Start a capture. A device runs one capture at a time."""
        snapshot = captures.start(plan_of(body, sources))
        response.headers["Location"] = request.url_for("get_capture", capture_id=snapshot.row.id).path
        return CaptureOut.of(snapshot)

    @router.get("", responses=problems(404))
    def list_captures(
        limit: Limit = 50,
        cursor: Cursor = None,
        q: Annotated[
            str | None,
            Query(max_length=200, description="Text to look for in name, notes, source, tags and metadata."),
        ] = None,
        state: CaptureState | None = None,
        deleted: Annotated[bool, Query(description="List removed captures instead.")] = False,
        group: Annotated[
            str | None, Query(max_length=64, description="Captures that were started together, by their group's id.")
        ] = None,
        tag: Annotated[str | None, Query(max_length=64, description="Captures with this tag.")] = None,
        grade: Annotated[Grade | None, Query(description="Captures with this verdict.")] = None,
        keep: Annotated[bool | None, Query(description="Captures that are, or are not, to be kept.")] = None,
        sort: Annotated[
            CaptureSort, Query(description="By which all captures are sorted, not only those of a page.")
        ] = CaptureSort.STARTED,
        descending: Annotated[bool, Query(description="The newest, largest or last first.")] = True,
    ) -> CapturePage:
        """Captures, newest first unless another order is asked for. All pages are asked for with the same order."""
        wanted = CaptureFilter(query=q, state=state, deleted=deleted, group=group, tag=tag, grade=grade, keep=keep)
        page = captures.list(limit, cursor, sort, descending, **wanted)
        items = [CaptureOut.of(snapshot) for snapshot in captures.snapshots(page.items)]
        return CapturePage(items=items, next_cursor=page.next_cursor, total=page.total or 0)

    @router.get("/{capture_id:id}", responses=problems(404))
    def get_capture(capture_id: str) -> CaptureOut:
        """State, counters and recording of a capture."""
        return CaptureOut.of(captures.get(capture_id))

    @router.patch("/{capture_id:id}", responses=problems(404, 507))
    def change_capture(capture_id: str, body: CaptureChange) -> CaptureOut:
        """Change its name, notes, tags or metadata, or exclude it from retention."""
        tags = None if body.tags is None else tuple(dict.fromkeys(body.tags))
        captures.update(capture_id, name=body.name, notes=body.notes, keep=body.keep, tags=tags, metadata=body.metadata)
        return CaptureOut.of(captures.get(capture_id))

    _add_end_routes(router, captures)
    return router


def _add_end_routes(router: APIRouter, captures: Captures) -> None:
    """Routes that stop, remove, restore and purge a capture."""

    @router.delete("/{capture_id:id}", status_code=HTTPStatus.NO_CONTENT, responses=problems(404, 409))
    def remove_capture(capture_id: str) -> None:
        """Remove it with its files and reconstructions; `:restore` undoes it for some days, `:purge` frees the disk."""
        captures.removal.remove(capture_id)

    @router.post("/{capture_id:id}:purge", status_code=HTTPStatus.NO_CONTENT, responses=problems(404, 409))
    def purge_capture(capture_id: str, idempotency_key: IdempotencyKey = None) -> None:
        """Delete a removed capture for good, before retention does. It is gone at once; its files follow soon."""
        if captures.get(capture_id).row.deleted_at is None:
            raise BusyError(f"capture {capture_id} has not been removed: remove it first, then it can be purged")
        captures.removal.purge(capture_id)

    @router.post("/{capture_id:id}:restore", responses=problems(404, 409))
    def restore_capture(capture_id: str, idempotency_key: IdempotencyKey = None) -> CaptureOut:
        """Undo its removal."""
        captures.removal.restore(capture_id)
        return CaptureOut.of(captures.get(capture_id))

    @router.post("/{capture_id:id}:stop", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def stop_capture(capture_id: str, idempotency_key: IdempotencyKey = None) -> CaptureOut:
        """End the acquisition; the reconstruction is refined. A second call ends the refinement too."""
        captures.stop(capture_id)
        return CaptureOut.of(captures.get(capture_id))


def plan_of(body: CaptureRequest, sources: Sources) -> Plan:
    """What a request asks for. Raises UnknownIdError for an unknown device."""
    return Plan(
        source=sources.named(body.source, body.device, body.camera, body.noise),
        frames=body.frames,
        seconds=body.seconds,
        pretrigger_s=body.pretrigger_s,
        name=body.name,
        notes=body.notes,
        record=body.record,
        reconstruct=body.reconstruct,
        options=body.options,
        intrinsics=body.intrinsics.intrinsics() if body.intrinsics else None,
    )
