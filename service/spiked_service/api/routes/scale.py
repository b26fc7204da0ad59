"""`reconstructions/ID/scale`: metres for a scene, and which way is up."""

import numpy as np
from fastapi import APIRouter
from fastapi.routing import APIRoute

from spiked.baseline_scale import scale_by_baseline
from spiked.board import Board
from spiked.board_scale import scale_by_board
from spiked.errors import ConfigurationError, RecordingError
from spiked.frame_of_reference import FrameOfReference
from spiked.render import Camera
from spiked.scene import Scene
from spiked.tag_scale import VIEWS, scale_by_tags
from spiked.trajectory import BRIDGED_S
from spiked.upright import find_floor, up_by_gravity, up_by_points
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import ConflictError, NoPoseError, problems
from spiked_service.api.results import Result, Results, thinned
from spiked_service.api.schemas.scale import (
    BaselineScaleOut,
    BaselineScaleRequest,
    BoardScaleOut,
    BoardScaleRequest,
    FoundTagOut,
    ScaleOut,
    ScaleRequest,
    TagScaleOut,
    TagScaleRequest,
    UpRequest,
)
from spiked_service.captures.captures import Captures
from spiked_service.captures.clock_offset import clock_offset
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.scene_scale import ScaleSource, SceneScale, read_scale, write_scale
from spiked_service.store.catalogue import UnknownIdError

RIG_POSES = 20_000
"""Poses of each camera of a rig, about: between poses 5 ms apart a hand at 10 m/s2 leaves the line by 0.03 mm."""


def scale_routes(
    rows: ReconstructionRepository, results: Results, captures: Captures, route_class: type[APIRoute]
) -> APIRouter:
    """`scale` below `reconstructions/ID`."""
    router = APIRouter(
        prefix="/reconstructions/{reconstruction_id:id}/scale", tags=["reconstructions"], route_class=route_class
    )

    @router.get("", responses=problems(404))
    def get_scale(reconstruction_id: str) -> ScaleOut:
        """Metres for its unit of length, and the direction of up."""
        return ScaleOut.of(read_scale(rows.folder(reconstruction_id)))

    @router.put("", responses=problems(404, 409, 507))
    def set_scale(reconstruction_id: str, body: ScaleRequest) -> ScaleOut:
        """Store what was measured, unless somebody stored something else meanwhile."""
        result = results.of(rows.get(reconstruction_id), body.version)
        changes: dict[str, object] = {}
        if body.metres_per_unit is not None:
            changes = _known(body.metres_per_unit, body.sigma, ScaleSource.LENGTH)
        if body.up is not None:
            changes["up"] = FrameOfReference(up=body.up).direction
        return _stored(result, body.revision, changes)

    @router.delete("", responses=problems(404, 507))
    def remove_scale(reconstruction_id: str) -> ScaleOut:
        """Forget the scale and the direction of up."""
        return ScaleOut.of(write_scale(rows.folder(reconstruction_id), SceneScale()))

    _add_searches(router, rows, results)
    _add_rig(router, rows, results, captures)
    return router


def _add_searches(router: APIRouter, rows: ReconstructionRepository, results: Results) -> None:
    """What finds scale or up in the scene."""

    @router.post(":tag", responses=problems(404, 409, 507))
    def scale_by_tag(
        reconstruction_id: str, body: TagScaleRequest, idempotency_key: IdempotencyKey = None
    ) -> TagScaleOut:
        """Find AprilTags of known size in the scene, and store the scale that they give."""
        result = results.of(rows.get(reconstruction_id))
        camera, path = _camera(result), result.path(4 * VIEWS)
        with results.downloads():
            found = scale_by_tags(Scene.read_ply(result.scene), path, camera, body.side_m, body.family)
        tags = [
            FoundTagOut(tag=one.tag, views=one.views, side=one.side, sigma=one.sigma, corners=one.corners.tolist())
            for one in found.tags
        ]
        changes = _known(found.metres_per_unit, found.sigma, ScaleSource.TAG)
        return TagScaleOut(scale=_stored(result, body.revision, changes), tags=tags)

    @router.post(":board", responses=problems(404, 409, 507))
    def scale_by_a_board(
        reconstruction_id: str, body: BoardScaleRequest, idempotency_key: IdempotencyKey = None
    ) -> BoardScaleOut:
        """Find a ChArUco board of known size in the scene, and store the scale that it gives."""
        result = results.of(rows.get(reconstruction_id))
        camera, path, board = _camera(result), result.path(4 * VIEWS), Board.parse(body.board, body.dictionary)
        with results.downloads():
            found = scale_by_board(Scene.read_ply(result.scene), path, camera, board, body.square_m)
        changes = _known(found.metres_per_unit, found.sigma, ScaleSource.BOARD)
        return BoardScaleOut(
            scale=_stored(result, body.revision, changes),
            square=found.square,
            views=found.views,
            corners=found.corners,
            error_px=found.error_px,
        )

    @router.post(":up", responses=problems(404, 409, 507))
    def find_up(reconstruction_id: str, body: UpRequest, idempotency_key: IdempotencyKey = None) -> ScaleOut:
        """Store which way is up: by gravity at a frame, by points of the floor, or by the floor, which is found."""
        result = results.of(rows.get(reconstruction_id))
        with results.downloads():
            x, y, z = _up(result, body).tolist()
        return _stored(result, body.revision, {"up": (x, y, z)})


def _add_rig(router: APIRouter, rows: ReconstructionRepository, results: Results, captures: Captures) -> None:
    """What finds the scale by two paths."""

    @router.post(":baseline", responses=problems(404, 409, 507))
    def scale_by_a_baseline(
        reconstruction_id: str, body: BaselineScaleRequest, idempotency_key: IdempotencyKey = None
    ) -> BaselineScaleOut:
        """Store the scale by the distance of two cameras of a rig, whose reconstructions were merged."""
        row = rows.get(reconstruction_id)
        result = results.of(row)
        others = result.published.paths
        if not others:
            raise ConfigurationError(
                "a baseline needs the paths of two cameras, and this map has one: merge it with the reconstruction of "
                "the other camera"
            )
        second = results.poses_along(result, body.path)
        offset_s = body.offset_s
        if offset_s is None:
            offset_s = _offset_s(captures, row.capture_id, others[body.path - 1].capture_id)
        with results.downloads():
            first, other = result.path(RIG_POSES), thinned(second, RIG_POSES)
            found = scale_by_baseline(first, other, body.baseline_m, offset_s)
        changes = _known(found.metres_per_unit, found.sigma, ScaleSource.BASELINE)
        scale = _stored(result, body.revision, changes)
        return BaselineScaleOut(scale=scale, poses=found.poses, offset_s=offset_s)


def _offset_s(captures: Captures, first_id: str, second_id: str) -> float:
    """By the clocks of both recordings. Raises ConfigurationError if they do not say it."""
    try:
        return clock_offset(captures, first_id, second_id).seconds
    except (RecordingError, UnknownIdError) as error:
        raise ConfigurationError(f"the offset of the two recordings is not known: {error}; give offset_s") from error


def _camera(result: Result) -> Camera:
    """Raises ConfigurationError if the optics are not known."""
    if result.camera is None:
        raise ConfigurationError("the optics of this capture are not known; give a known length instead")
    return result.camera


def _known(metres_per_unit: float, sigma: float | None, source: ScaleSource) -> dict[str, object]:
    return {"metres_per_unit": metres_per_unit, "sigma": sigma, "source": source}


def _stored(result: Result, revision: int, changes: dict[str, object]) -> ScaleOut:
    """Store changes of the scale that was of a revision.

    Raises BusyError if it is not of that any more, and ConflictError for a version of an earlier run.
    """
    version, scale = result.published.version, read_scale(result.folder)
    if version <= scale.since:
        raise ConflictError(
            f"version {version} is of an earlier run, whose unit of length is another one: measure in a version "
            f"after {scale.since}"
        )
    return ScaleOut.of(write_scale(result.folder, scale.model_copy(update={**changes, "version": version}), revision))


def _up(result: Result, body: UpRequest) -> np.ndarray:
    """Raises SceneError if no floor is found, NoPoseError, and ConfigurationError."""
    if body.gravity is not None:
        poses, rate_hz = result.poses(), result.frame_rate_hz
        row = 0 if body.frame is None else poses.nearest((body.frame + 0.5) / rate_hz, BRIDGED_S)
        if row is None:
            raise NoPoseError(f"there is no pose within {1000 * BRIDGED_S:g} ms of frame {body.frame} in this version")
        return up_by_gravity(body.gravity, poses.trajectory(range(row, row + 1)).rotations[0])
    path = result.path(4 * VIEWS)
    if body.points is not None:
        return up_by_points(np.array(body.points), path.centres)
    return find_floor(Scene.read_ply(result.scene), path).up
