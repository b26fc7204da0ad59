"""Recordings from elsewhere."""

from datetime import datetime
from typing import Annotated, Self

from pydantic import ConfigDict, Field, StrictInt, model_validator

from spiked.camera import Rate, StoredCameraOptions
from spiked.recording.sidecar import Sidecar
from spiked_service.api.schemas.base import (
    Id,
    In,
    IntrinsicsModel,
    Name,
    Notes,
    Out,
    at_most_one_of,
    camera_example,
    examples,
)
from spiked_service.api.schemas.captures import ProfileModel
from spiked_service.conversion.form import Form

MAX_UPLOAD_BYTES = 1 << 42
"""Upper bound of the schema, 4 TiB; `limit_upload_bytes` is the limit in effect."""


class GeometryModel(In, StoredCameraOptions):
    """What the recording holds, where there is no sidecar."""

    model_config = camera_example(width=640, height=360, rate=40_000, mosaic="BGGR")

    intrinsics: IntrinsicsModel | None = None
    frame_rate_hz: Rate | None = Field(None, deprecated=True, description="Deprecated: use rate.")

    def options(self) -> StoredCameraOptions:
        """The same for the library."""
        stated = self.model_dump(exclude_none=True)
        rate = stated.pop("frame_rate_hz", None)
        return StoredCameraOptions(**({} if rate is None else {"rate": rate}) | stated)


class UploadSidecar(Sidecar):
    """A recording's sidecar, as it stands beside the `.dat`."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)


class UploadProfile(ProfileModel):
    """The profile of the camera that a recording is of."""

    model_config = camera_example(model="M1K40", width=1000, height=1000, mosaic="BGGR")

    calibration: None = None
    """Sent on its own, by `PUT uploads/ID/calibration`: a file name says nothing to another machine."""


class UploadRequest(In):
    """A recording, or another file with the frames of one, that is about to come."""

    model_config = examples(
        {
            "name": "garden.dat",
            "bytes": 16_000_000,
            "geometry": {
                "width": 400,
                "height": 250,
                "rate": 20000,
                "layout": "compact",
                "intrinsics": {"fx": 346.4, "fy": 346.4, "cx": 200, "cy": 125},
            },
        },
        rules=at_most_one_of(profile="object", device="string"),
    )

    name: Name = Field(min_length=1, description="What the capture will be called.")
    notes: Notes = ""
    bytes: StrictInt = Field(ge=1, le=MAX_UPLOAD_BYTES, description="Size of the whole file.")
    sidecar: UploadSidecar | None = None
    geometry: GeometryModel | None = Field(None, description="Wins over the sidecar.")
    profile: UploadProfile | None = Field(None, description="Camera profile, which says what geometry does not.")
    device: Annotated[str, Field(min_length=1, max_length=4096)] | None = Field(
        None, description="Device that the recording is of: its profile and its calibration are used."
    )
    sha256: str | None = Field(
        None, pattern="^[0-9a-f]{64}$", description="Of the whole file, in hex; checked at the end."
    )
    form: Form | None = Field(
        None,
        description="Raw bytes of a camera (`usb`, `pcie`), arrays of NumPy or HDF5 (`array`) and frames without ends "
        "of rows (`bits`) are converted to a recording. Default: a recording if it has a sidecar or a stated layout, "
        "otherwise detected.",
    )
    array: Annotated[str, Field(min_length=1, max_length=200)] | None = Field(
        None, description="Name of the array of spikes, where the file has several with three axes."
    )

    @model_validator(mode="after")
    def _one_profile(self) -> Self:
        if self.profile is not None and self.device is not None:
            raise ValueError("a profile and a device, which has one, are both given; give one of them")
        return self


class UploadOut(Out):
    """How far an upload is."""

    id: Id
    name: str
    bytes: int = Field(description="What it will be.")
    offset_bytes: int = Field(description="What has come; the next chunk begins here.")
    created_at: datetime
    capture_id: str | None = Field(description="What it became.")


class UploadsOut(Out):
    """Uploads that have not become captures, newest first."""

    items: list[UploadOut]
