"""Recordings from elsewhere."""

from datetime import datetime

from pydantic import ConfigDict, Field, StrictBool, StrictFloat, StrictInt

from spiked.recording.sidecar import Sidecar
from spiked.sensor import BitOrder, Layout, Mosaic
from spiked_service.api.schemas.base import Id, In, IntrinsicsModel, Name, Notes, Out, examples

MAX_UPLOAD_BYTES = 1 << 42
"""Upper bound of the schema, 4 TiB; `limit_upload_bytes` is the limit in effect."""


class GeometryModel(In):
    """What the recording holds, where there is no sidecar."""

    width: StrictInt | None = Field(None, ge=1, le=16384)
    height: StrictInt | None = Field(None, ge=1, le=16384)
    frame_rate_hz: StrictFloat | None = Field(None, gt=0, le=1e7)
    layout: Layout | None = None
    bit_order: BitOrder | None = None
    flipped: StrictBool | None = Field(None, description="Rows are stored bottom-up.")
    mosaic: Mosaic | None = Field(None, description="Colour pattern of the upright image.")
    intrinsics: IntrinsicsModel | None = None


class UploadSidecar(Sidecar):
    """A recording's sidecar, as it stands beside the `.dat`."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)


class UploadRequest(In):
    """A recording that is about to come."""

    model_config = examples(
        {
            "name": "garden.dat",
            "bytes": 16_000_000,
            "geometry": {
                "width": 400,
                "height": 250,
                "frame_rate_hz": 20000,
                "layout": "compact",
                "intrinsics": {"fx": 346.4, "fy": 346.4, "cx": 200, "cy": 125},
            },
        }
    )

    name: Name = Field(min_length=1, description="What the capture will be called.")
    notes: Notes = ""
    bytes: StrictInt = Field(ge=1, le=MAX_UPLOAD_BYTES, description="Size of the whole `.dat`.")
    sidecar: UploadSidecar | None = None
    geometry: GeometryModel | None = Field(None, description="Wins over the sidecar.")
    sha256: str | None = Field(
        None, pattern="^[0-9a-f]{64}$", description="Of the whole file, in hex; checked at the end."
    )


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
