"""The figures of a report, read from `report.json`: every part may be missing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from spiked.errors import SceneError
from spiked.lens import Lens, distortion_of
from spiked.render import Camera
from spiked.sensor import Intrinsics, Sensor

Curve = list[tuple[float, float]]


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class SensorFigures(_Part):
    """Size and frame rate."""

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    frame_rate_hz: float | None = Field(None, gt=0)


class StateChange(_Part):
    """A change of the tracking state."""

    time_s: float
    state: str
    reason: str = ""


class ViewFigures(_Part):
    """One tracked view."""

    time_s: float
    state: str
    frames: int | None = None
    rate: float | None = None
    """Mean spikes a pixel and frame."""
    motion_px: float | None = None
    inliers: float | None = None
    chi2: float | None = None
    sigma_px: float | None = None
    """Predicted error of the pose, as a displacement of the image."""


class GapFigures(_Part):
    """Lost frames."""

    first_frame: int
    frames: int


class ClosureFigures(_Part):
    """A closed loop."""

    earlier_s: float
    later_s: float


class MachineFigures(_Part):
    """The machine of the run."""

    processor: str = ""
    cores: int | None = None
    memory_bytes: int | None = None
    system: str = ""


class Figures(_Part):
    """What `report.json` says, as far as the report shows it. Options and sections of maps are shown as they are."""

    versions: dict[str, str] = {}
    machine: MachineFigures | None = None
    sensor: SensorFigures | None = None
    focal_px: tuple[float, float] | None = None
    principal_point_px: tuple[float, float] | None = None
    distortion: Lens | None = None
    focal_estimated: bool | None = None
    focal_relative_sigma: float | None = None
    distortion_estimated: bool | None = None
    options: dict[str, Any] = {}
    frames: int | None = None
    poses: int | None = None
    gaps: list[GapFigures] = []
    outcome: str = "complete"
    reason: str = ""
    state: str | None = None
    states: list[StateChange] = []
    views: list[ViewFigures] = []
    warnings: list[str] = []
    closures: list[ClosureFigures] = []
    path_error_predicted: float | None = None
    correction_deg: float | None = None
    splats: int | None = None
    steps: int | None = None
    psnr_db: float | None = None
    psnr_of_views_over_seconds: Curve = []
    seconds: dict[str, float] = {}
    extended: dict[str, Any] = {}
    merged: dict[str, Any] = {}
    localisation: dict[str, Any] = {}
    evaluation: dict[str, float] = {}
    job: dict[str, Any] = {}

    @classmethod
    def read(cls, document: dict[str, Any], origin: str) -> "Figures":
        """Raises SceneError if a part is not what `report.json` has there."""
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise SceneError(
                f"{origin} is not a report of this program, at {where}: {first['msg']}; reconstruct again"
            ) from error

    @property
    def final_psnr_db(self) -> float | None:
        """PSNR of the mapped views at the end, with their noise."""
        if self.psnr_db is not None:
            return self.psnr_db
        return self.psnr_of_views_over_seconds[-1][1] if self.psnr_of_views_over_seconds else None

    def column(self, name: str) -> NDArray[np.float64]:
        """A figure of all views [n]; NaN where it is not known."""
        values = (getattr(view, name) for view in self.views)
        return np.array([np.nan if value is None else value for value in values], np.float64)

    @property
    def optics(self) -> Intrinsics | None:
        """The camera's lens, if it is known."""
        if self.focal_px is None or self.sensor is None:
            return None
        cx, cy = self.principal_point_px or (self.sensor.width / 2, self.sensor.height / 2)
        return Intrinsics(*self.focal_px, cx, cy, distortion_of(self.distortion))

    @property
    def camera(self) -> Camera | None:
        """The camera that made the result, if it is known."""
        optics = self.optics
        return None if optics is None or self.sensor is None else Camera(optics, self.sensor.width, self.sensor.height)

    @property
    def described_sensor(self) -> Sensor | None:
        """Size, rate and optics, as exports of trajectories need them."""
        if self.sensor is None:
            return None
        return Sensor(self.sensor.width, self.sensor.height, self.sensor.frame_rate_hz or 1.0, intrinsics=self.optics)
