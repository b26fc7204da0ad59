"""What is done with a scene: cleaning it, and giving it metres and up."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel

from spiked.client.connection import Connection, plain
from spiked.client.models import (
    BaselineScaleOut,
    BoardScaleOut,
    EditedOut,
    OutlineModel,
    ReconstructionOut,
    ScaleOut,
    TagScaleOut,
)

_Model = TypeVar("_Model", bound=BaseModel)
_Vector = Sequence[float]
"""Three numbers, in the axes of the scene."""


class EditingMethods:
    """What `Spiked` does with scenes.

    A change replaces the version or the revision that it names, by default the one that is newest now; it is refused
    if that is not the newest any more. Searching and cleaning take seconds to minutes: give the client time.
    """

    _connection: Connection

    def clean(
        self,
        reconstruction_id: str,
        *,
        floaters: bool = True,
        split: bool = True,
        box: tuple[_Vector, _Vector] | None = None,
        outline: OutlineModel | None = None,
        version: int | None = None,
    ) -> EditedOut:
        """Publish a version without floaters, what is outside a box (low and high corner) and inside an outline.

        `split` replaces splats larger than a quarter of the scene, together with `floaters`.
        """
        body: dict[str, Any] = {
            "version": self._version(reconstruction_id) if version is None else version,
            "floaters": floaters,
            "split": split,
            "box": None if box is None else {"low": list(box[0]), "high": list(box[1])},
            "outline": plain(outline),
        }
        return self._connection.post(f"reconstructions/{reconstruction_id}:clean", body, EditedOut)

    def revert(self, reconstruction_id: str, to: int, *, version: int | None = None) -> EditedOut:
        """Publish the earlier version `to` again, as the newest."""
        body = {"version": self._version(reconstruction_id) if version is None else version, "to": to}
        return self._connection.post(f"reconstructions/{reconstruction_id}:revert", body, EditedOut)

    def scale(self, reconstruction_id: str) -> ScaleOut:
        """Metres for the unit of its scene, and the direction of up; None where it is not known."""
        return self._connection.get(f"reconstructions/{reconstruction_id}/scale", ScaleOut)

    def set_scale(
        self,
        reconstruction_id: str,
        *,
        metres_per_unit: float | None = None,
        sigma: float | None = None,
        up: _Vector | None = None,
        version: int | None = None,
        revision: int | None = None,
    ) -> ScaleOut:
        """Store what was measured in a version, the newest by default; what is not given stays as it is.

        `sigma` is the relative standard deviation of metres_per_unit.
        """
        given = {"metres_per_unit": metres_per_unit, "sigma": sigma, "up": _list(up), "version": version}
        body = self._replacing(reconstruction_id, revision, given)
        return self._connection.change("PUT", f"reconstructions/{reconstruction_id}/scale", body, ScaleOut)

    def forget_scale(self, reconstruction_id: str) -> ScaleOut:
        """Forget the scale and the direction of up."""
        return self._connection.change("DELETE", f"reconstructions/{reconstruction_id}/scale", None, ScaleOut)

    def scale_by_tag(
        self, reconstruction_id: str, side_m: float, *, family: str = "36h11", revision: int | None = None
    ) -> TagScaleOut:
        """Find AprilTags whose black square has this side, and store the scale that they give."""
        given = {"side_m": side_m, "family": family}
        return self._found(reconstruction_id, "tag", revision, given, TagScaleOut)

    def scale_by_board(
        self,
        reconstruction_id: str,
        board: str,
        square_m: float,
        *,
        dictionary: str = "4x4_100",
        revision: int | None = None,
    ) -> BoardScaleOut:
        """Find a ChArUco board of so many squares, as `9x6`, of this side, and store the scale that it gives."""
        given = {"board": board, "square_m": square_m, "dictionary": dictionary}
        return self._found(reconstruction_id, "board", revision, given, BoardScaleOut)

    def scale_by_baseline(
        self,
        reconstruction_id: str,
        baseline_m: float,
        *,
        path: int = 1,
        offset_s: float | None = None,
        revision: int | None = None,
    ) -> BaselineScaleOut:
        """Store the scale by the distance of two cameras of a rig, whose reconstructions were merged.

        `path` is that of the second camera, see `paths`. Its recording began `offset_s` later, by default as the
        clocks of both recordings say.
        """
        given = {"baseline_m": baseline_m, "path": path, "offset_s": offset_s}
        return self._found(reconstruction_id, "baseline", revision, given, BaselineScaleOut)

    def find_up(
        self,
        reconstruction_id: str,
        *,
        gravity: _Vector | None = None,
        frame: int | None = None,
        points: Sequence[_Vector] | None = None,
        revision: int | None = None,
    ) -> ScaleOut:
        """Store which way is up: by gravity in the axes of the camera at a frame, by points of the floor, or by the
        floor, which is found.
        """
        rows = None if points is None else [list(point) for point in points]
        given = {"gravity": _list(gravity), "frame": frame, "points": rows}
        return self._found(reconstruction_id, "up", revision, given, ScaleOut)

    def _version(self, reconstruction_id: str) -> int:
        return self._connection.get(f"reconstructions/{reconstruction_id}", ReconstructionOut).version

    def _replacing(
        self, reconstruction_id: str, revision: int | None, given: Mapping[str, object]
    ) -> Mapping[str, object]:
        """A change of the scale of that revision, or of the one that is stored now."""
        known = self.scale(reconstruction_id).revision if revision is None else revision
        return {"revision": known, **{name: value for name, value in given.items() if value is not None}}

    def _found(
        self, reconstruction_id: str, by: str, revision: int | None, given: Mapping[str, object], model: type[_Model]
    ) -> _Model:
        body = self._replacing(reconstruction_id, revision, given)
        return self._connection.post(f"reconstructions/{reconstruction_id}/scale:{by}", body, model)


def _list(vector: _Vector | None) -> list[float] | None:
    return None if vector is None else [float(part) for part in vector]
