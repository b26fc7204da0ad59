"""`reconstructions/ID:clean` and `:revert`: edited scenes are versions like any."""

from pathlib import Path

from fastapi import APIRouter
from fastapi.routing import APIRoute

from spiked.cleaning import FloaterRemoval, clean
from spiked.scene import Scene
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import problems
from spiked_service.api.results import Results
from spiked_service.api.schemas.cleaning import CleanRequest, EditedOut, RevertRequest
from spiked_service.base.priority import behind_others
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.published import Published
from spiked_service.results.scene_scale import forget_scale, put_scale_back, read_scale
from spiked_service.results.versions import Publisher

_POSES = 256
"""Poses of the path that views are chosen from."""
_NOTHING = dict.fromkeys(("outside", "outlined", "floaters", "split", "shrunk", "large"), 0)
"""What going back to an earlier version removes and changes."""


def cleaning_routes(rows: ReconstructionRepository, results: Results, route_class: type[APIRoute]) -> APIRouter:
    """`:clean` and `:revert` of a reconstruction."""
    router = APIRouter(
        prefix="/reconstructions/{reconstruction_id:id}", tags=["reconstructions"], route_class=route_class
    )

    @router.post(":clean", responses=problems(404, 409, 507))
    def clean_scene(reconstruction_id: str, body: CleanRequest, idempotency_key: IdempotencyKey = None) -> EditedOut:
        """Publish a version without what is outside of a box, inside of an outline, and without floaters.

        With floaters, splats larger than a quarter of the scene are replaced by smaller ones that show the same.

        `:revert` undoes it. With floaters it takes seconds to minutes: wait long enough for the answer.
        """
        result = results.of(rows.get(reconstruction_id), body.version)
        with results.downloads():
            found = behind_others(
                lambda: clean(
                    Scene.read_ply(result.scene),
                    result.path(_POSES),
                    result.camera,
                    None if body.box is None else body.box.box(),
                    FloaterRemoval(split=body.split) if body.floaters else None,
                    outline=None if body.outline is None else body.outline.outline(),
                )
            )
        published = rows.publish_edit(
            reconstruction_id, body.version, lambda publisher: publisher.again(result.published, found.scene)
        )
        return EditedOut(
            version=published.version,
            splats=published.splats,
            outside=found.outside,
            outlined=found.outlined,
            floaters=found.floaters,
            split=found.split,
            shrunk=found.shrunk,
            large=found.large,
        )

    @router.post(":revert", responses=problems(404, 409, 507))
    def revert_scene(reconstruction_id: str, body: RevertRequest, idempotency_key: IdempotencyKey = None) -> EditedOut:
        """Publish an earlier version again, as the newest."""
        earlier = results.of(rows.get(reconstruction_id), body.to).published
        folder = rows.folder(reconstruction_id)
        published = rows.publish_edit(
            reconstruction_id,
            body.version,
            lambda publisher: _published_again(publisher, earlier, folder, body.version),
        )
        return EditedOut(version=published.version, splats=published.splats, **_NOTHING)

    return router


def _published_again(publisher: Publisher, earlier: Published, folder: Path, newest: int) -> Published:
    """An earlier version as the newest. One of another unit of length has no scale."""
    scale = read_scale(folder)
    if earlier.version > scale.since:
        return publisher.again(earlier)
    forget_scale(folder, newest)  # first: after a kill there is no scale rather than a wrong one
    try:
        return publisher.again(earlier)
    except BaseException:
        put_scale_back(folder, scale)
        raise
