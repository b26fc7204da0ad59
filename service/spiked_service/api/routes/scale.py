"""`reconstructions/ID/scale`: metres for a scene, and which way is up."""

from fastapi import APIRouter
from fastapi.routing import APIRoute

from spiked.errors import ConfigurationError
from spiked.frame_of_reference import FrameOfReference
from spiked.scene import Scene
from spiked.tag_scale import VIEWS, scale_by_tags
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import problems
from spiked_service.api.results import Results
from spiked_service.api.schemas.scale import FoundTagOut, ScaleOut, ScaleRequest, TagScaleOut, TagScaleRequest
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.scene_scale import ScaleSource, SceneScale, read_scale, write_scale


def scale_routes(rows: ReconstructionRepository, results: Results, route_class: type[APIRoute]) -> APIRouter:
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
        folder = rows.folder(reconstruction_id)
        version = results.of(rows.get(reconstruction_id)).published.version
        scale = read_scale(folder).model_copy(update={"version": version})
        if body.metres_per_unit is not None:
            length = {"metres_per_unit": body.metres_per_unit, "sigma": body.sigma, "source": ScaleSource.LENGTH}
            scale = scale.model_copy(update=length)
        if body.up is not None:
            scale = scale.model_copy(update={"up": FrameOfReference(up=body.up).direction})
        return ScaleOut.of(write_scale(folder, scale, body.revision))

    @router.delete("", responses=problems(404, 507))
    def remove_scale(reconstruction_id: str) -> ScaleOut:
        """Forget the scale and the direction of up."""
        return ScaleOut.of(write_scale(rows.folder(reconstruction_id), SceneScale()))

    @router.post(":tag", responses=problems(404, 409, 507))
    def scale_by_tag(
        reconstruction_id: str, body: TagScaleRequest, idempotency_key: IdempotencyKey = None
    ) -> TagScaleOut:
        """Find AprilTags of known size in the scene, and store the scale that they give."""
        result = results.of(rows.get(reconstruction_id))
        camera = result.camera
        if camera is None:
            raise ConfigurationError("the optics of this capture are not known; give a known length instead")
        path = result.path(4 * VIEWS)
        with results.downloads():
            found = scale_by_tags(Scene.read_ply(result.scene), path, camera, body.side_m, body.family)
        folder = rows.folder(reconstruction_id)
        scale = read_scale(folder).model_copy(
            update={
                "metres_per_unit": found.metres_per_unit,
                "sigma": found.sigma,
                "source": ScaleSource.TAG,
                "version": result.published.version,
            }
        )
        tags = [
            FoundTagOut(tag=one.tag, views=one.views, side=one.side, sigma=one.sigma, corners=one.corners.tolist())
            for one in found.tags
        ]
        return TagScaleOut(scale=ScaleOut.of(write_scale(folder, scale, body.revision)), tags=tags)

    return router
