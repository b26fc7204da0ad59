"""Maps: localising recordings in them, merging them, and what was found."""

from typing import Any

from spiked.client.connection import Connection, plain
from spiked.client.models import (
    IntrinsicsModel,
    LocalisationOut,
    PathOut,
    PathsOut,
    ReconstructionOut,
    RegistrationOut,
)


class MapMethods:
    """What `Spiked` does with maps."""

    _connection: Connection

    def merge(self, first_id: str, second_id: str, *, seed: int = 0, priority: int = 0) -> ReconstructionOut:
        """Make one map of two reconstructions of a place, in the frame of reference and unit of the first.

        The result is another reconstruction of the first one's capture.
        """
        body = {"other": second_id, "seed": seed, "priority": priority}
        return self._connection.post(f"reconstructions/{first_id}:merge", body, ReconstructionOut)

    def localise(
        self,
        map_id: str,
        capture_id: str,
        *,
        first_frame: int = 0,
        frames: int | None = None,
        intrinsics: IntrinsicsModel | None = None,
        priority: int = 0,
    ) -> ReconstructionOut:
        """Find where the camera of a recording was in the map of a reconstruction; 1,000 frames suffice.

        When it is complete, `trajectory` and `localisation` have the poses.
        """
        body: dict[str, Any] = {
            "capture_id": capture_id,
            "first_frame": first_frame,
            "frames": frames,
            "intrinsics": plain(intrinsics),
            "priority": priority,
        }
        return self._connection.post(f"reconstructions/{map_id}:localise", body, ReconstructionOut)

    def localisation(self, reconstruction_id: str) -> LocalisationOut:
        """Of a localisation: whether the map was recognised, and the pose of each window of frames."""
        return self._connection.get(f"reconstructions/{reconstruction_id}/localisation", LocalisationOut)

    def registration(self, reconstruction_id: str) -> RegistrationOut:
        """Of an extended or merged map: how the two were brought together."""
        return self._connection.get(f"reconstructions/{reconstruction_id}/registration", RegistrationOut)

    def paths(self, reconstruction_id: str, *, version: int | None = None) -> list[PathOut]:
        """The paths of all recordings through the scene of a version, its own first."""
        path = f"reconstructions/{reconstruction_id}/paths"
        return self._connection.get(path, PathsOut, version=version).items
