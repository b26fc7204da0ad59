"""What is known of a version of a scene beside its files."""

from datetime import datetime

from pydantic import BaseModel

from spiked.errors import ConfigurationError
from spiked.lens import Lens, distortion_of
from spiked.sensor import Intrinsics, Sensor


class OtherPath(BaseModel):
    """The path of another recording through the scene of a version."""

    capture_id: str
    """Its capture, which may have been removed since."""
    frame_rate_hz: float
    trajectory: str
    """Name of a pose file."""
    poses: int


class Published(BaseModel):
    """Metadata of a version, whose files are beside the index."""

    version: int
    white: float
    """Radiance shown as white, spikes per frame."""
    scene: str
    trajectory: str
    """Name of a pose file; of a TUM file in folders of older releases."""
    at: datetime
    splats: int
    poses: int
    """Frames with a pose. The trajectory of a long path that is still tracked has a pose a view, fewer than these."""
    scene_bytes: int
    psnr_db: float | None = None
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy (px), given or estimated."""
    distortion: Lens | None = None
    """Of the lens, with `intrinsics`."""
    slots: str | None = None
    """Name of the file of `ShownScene`, which only the newest versions have."""
    slots_began: int = 0
    """The number of these slots: `ShownScene.began`."""
    cleaned_from: int | None = None
    """The version that it is without what cleaning removed; None: it was not cleaned."""
    paths: list[OtherPath] = []
    """Of a map of several recordings: the paths of the others."""

    def optics(self, sensor: Sensor) -> Intrinsics:
        """The lens of the camera `sensor` that made it. Raises ConfigurationError for a version of an old release."""
        found = self.camera or sensor.intrinsics
        if found is None:
            raise ConfigurationError(f"version {self.version} was published without a lens: :restart makes a new one")
        return found

    @property
    def camera(self) -> Intrinsics | None:
        """The intrinsics with the distortion."""
        return None if self.intrinsics is None else Intrinsics(*self.intrinsics, distortion_of(self.distortion))
