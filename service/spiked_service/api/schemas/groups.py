"""Groups of captures that were started together."""

from pydantic import Field

from spiked_service.api.schemas.base import Id, In, Out, examples
from spiked_service.api.schemas.captures import CaptureOut, CaptureRequest
from spiked_service.captures.captures import MOST_GROUPED


class GroupRequest(In):
    """Captures to start together, or none of them."""

    model_config = examples({"captures": [{"source": "sim:?seed=1"}, {"source": "sim:?seed=2"}]})

    captures: list[CaptureRequest] = Field(min_length=2, max_length=MOST_GROUPED, description="A device each.")


class OffsetOut(Out):
    """When the frames of a capture came, by the clock of the machine."""

    capture_id: Id
    offset_s: float | None = Field(
        description="From the first recorded frame of the group's first capture to its own; negative if it began "
        "earlier. Null if it is not known."
    )
    sigma_s: float | None = Field(
        description="Standard deviation, from the jitter of the clock pairs; null with fewer than 4 of a recording. "
        "Delays that all pairs of a recording share are not in it: on a busy machine the error was up to "
        "8 times larger."
    )
    reason: str = Field(description="Why the offset is not known.")


class GroupOut(Out):
    """A group, with its captures in the order of the request."""

    id: Id
    captures: list[CaptureOut]
    offsets: list[OffsetOut] | None = Field(
        description="Of all captures but the first, against the first. Null until all have ended."
    )
