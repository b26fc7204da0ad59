"""Parameters and documented responses that several routes have in common."""

from typing import Annotated, Any

from fastapi import Query

from spiked_service.api.schemas.base import IN_DIGITS, LARGEST_INTEGER
from spiked_service.results.image_encoding import ImageFormat

Version = Annotated[
    int | None,
    Query(ge=1, le=LARGEST_INTEGER, description="Default: the newest; `GET versions` lists them."),
    IN_DIGITS,
]
FromS = Annotated[float | None, Query(ge=0, le=1e9, description="First time, seconds since the start of the capture.")]
ToS = Annotated[float | None, Query(ge=0, le=1e9, description="End time, not included, in seconds.")]
Column = Annotated[int, Query(ge=0, le=LARGEST_INTEGER, description="Of the upright image, from the left."), IN_DIGITS]
Row = Annotated[int, Query(ge=0, le=LARGEST_INTEGER, description="Of the upright image, from the top."), IN_DIGITS]
WishedImage = Annotated[ImageFormat | None, Query(description="Takes precedence over Accept; the default is PNG.")]

BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
ETAG: dict[str, Any] = {"ETag": {"description": "Changes with the content.", "schema": {"type": "string"}}}
NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "The content has not changed."}}
PICTURES: dict[str, Any] = {kind.media_type: BINARY for kind in ImageFormat}
