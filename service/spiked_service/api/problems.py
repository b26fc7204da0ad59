"""Errors as RFC 9457 problem details, with `what_to_do`."""

from difflib import get_close_matches
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from starlette.exceptions import HTTPException

from spiked.errors import SpikedError
from spiked.whole_files import FULL
from spiked_service.api.paths import allowed_methods
from spiked_service.base.errors import BusyError
from spiked_service.base.limits import OverloadedError
from spiked_service.captures.uploads import UploadBusyError, UploadError, UploadOffsetError, UploadTooLargeError
from spiked_service.cluster.remote_worker import FencedError
from spiked_service.results.frame_images import FrameNotRecordedError
from spiked_service.results.rate_statistics import NotInImageError
from spiked_service.store.catalogue import StoreError, UnknownIdError

MEDIA_TYPE = "application/problem+json"
_RETRY_S = 1
"""`Retry-After` of a busy service, seconds."""


class Problem(BaseModel):
    """RFC 9457 problem details."""

    model_config = ConfigDict(
        json_schema_serialization_defaults_required=True,
        json_schema_extra={
            "examples": [
                {
                    "type": "urn:spiked:problem:not-found",
                    "title": "Not Found",
                    "status": 404,
                    "detail": "there is no capture 01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10; GET captures lists them",
                    "instance": "/api/v1/captures/01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10",
                    "what_to_do": "list the ids with GET",
                }
            ]
        },
    )

    type: str = Field(description="urn:spiked:problem: followed by the kind of problem.")
    title: str
    status: int
    detail: str = Field(description="What is wrong, in one or more sentences.")
    instance: str | None = Field(None, description="Path of the request.")
    what_to_do: str | None = Field(None, description="How to correct it, if known.")


class NotReadyError(SpikedError):
    """The requested data does not exist yet."""


class NoPoseError(SpikedError):
    """The requested time or frame has no pose, or none yet."""


class NothingError(SpikedError):
    """The requested data does not exist, and nothing that runs will create it."""


class GoneError(SpikedError):
    """The requested data was removed."""


class ConflictError(SpikedError):
    """The request conflicts with the current state."""


class ForbiddenError(SpikedError):
    """The scope of the token does not allow the request."""


class UnsupportedTypeError(SpikedError):
    """The content type of the body is not supported."""


class KeyReusedError(SpikedError):
    """An idempotency key was used for another request."""


_STATUS: dict[type[SpikedError], HTTPStatus] = {
    UnknownIdError: HTTPStatus.NOT_FOUND,
    NotReadyError: HTTPStatus.NOT_FOUND,
    NoPoseError: HTTPStatus.NOT_FOUND,
    NothingError: HTTPStatus.NOT_FOUND,
    GoneError: HTTPStatus.NOT_FOUND,
    FencedError: HTTPStatus.GONE,
    FrameNotRecordedError: HTTPStatus.NOT_FOUND,
    NotInImageError: HTTPStatus.NOT_FOUND,
    ForbiddenError: HTTPStatus.FORBIDDEN,
    BusyError: HTTPStatus.CONFLICT,
    UploadBusyError: HTTPStatus.CONFLICT,
    UploadTooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    UploadOffsetError: HTTPStatus.CONFLICT,
    UploadError: HTTPStatus.CONFLICT,
    UnsupportedTypeError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    ConflictError: HTTPStatus.CONFLICT,
    KeyReusedError: HTTPStatus.UNPROCESSABLE_ENTITY,
    OverloadedError: HTTPStatus.SERVICE_UNAVAILABLE,
    StoreError: HTTPStatus.INSUFFICIENT_STORAGE,
}

_KINDS: dict[type[SpikedError], str] = {
    NotReadyError: "not-ready",
    NoPoseError: "no-pose",
    NothingError: "nothing-there",
    GoneError: "gone",
    FrameNotRecordedError: "not-recorded",
    NotInImageError: "not-in-image",
    BusyError: "busy",
    UploadBusyError: "busy",
    UploadOffsetError: "upload-offset",
    KeyReusedError: "idempotency-key-reused",
}

_WHAT_TO_DO: dict[int, str] = {
    400: "send a request as described in /openapi.json",
    401: "send Authorization: Bearer TOKEN; `spiked token create NAME` creates one",
    403: "use a token with the scope named in detail",
    404: "list the ids with GET",
    405: "use a method of the Allow header",
    408: "send the request again, without long pauses in its body",
    410: "end: another attempt has begun, or the job has ended",
    409: "read the state with GET, and repeat the request when the state allows it",
    411: "send Content-Length",
    413: "send a smaller body; upload recordings in chunks",
    415: "use a Content-Type of /openapi.json",
    416: "request a range that starts inside the file",
    422: "correct the request; /docs and /openapi.json describe its fields",
    429: "wait for the time in Retry-After",
    503: "repeat the request after the time in Retry-After",
    507: "free disk space in the data folder, or remove and purge captures",
}

_MORE: dict[str, str] = {
    "not-ready": "repeat the request later, or wait for its event",
    "no-pose": "request a time or frame of the range in detail, or repeat the request when more is tracked",
    "nothing-there": "follow the instruction in detail",
    "gone": "request an available version; GET versions lists them",
    "not-recorded": "request a frame of the range in detail",
    "idempotency-key-reused": "use a new key for a new request",
}


def problem(
    status: HTTPStatus | int,
    detail: str,
    headers: dict[str, str] | None = None,
    *,
    kind: str | None = None,
    instance: str | None = None,
    what_to_do: str | None = None,
) -> JSONResponse:
    """A response with problem details."""
    code = HTTPStatus(status)
    kind = kind or code.phrase.lower().replace(" ", "-").replace("'", "")
    body = Problem(
        type=f"urn:spiked:problem:{kind}",
        title=code.phrase,
        status=code.value,
        detail=detail,
        instance=instance,
        what_to_do=what_to_do or _MORE.get(kind) or _WHAT_TO_DO.get(code.value),
    )
    return JSONResponse(body.model_dump(), code.value, headers, MEDIA_TYPE)


def problem_of(error: SpikedError, request: Request) -> JSONResponse:
    """The response to a SpikedError."""
    status = next((_STATUS[kind] for kind in type(error).__mro__ if kind in _STATUS), HTTPStatus.UNPROCESSABLE_ENTITY)
    if isinstance(error.__cause__, OSError) and error.__cause__.errno in FULL:
        status = HTTPStatus.INSUFFICIENT_STORAGE
    headers = {"Retry-After": str(_RETRY_S)} if status is HTTPStatus.SERVICE_UNAVAILABLE else {}
    if isinstance(error, UploadOffsetError):
        headers["Upload-Offset"] = str(error.offset_bytes)
    return problem(status, str(error), headers, kind=_KINDS.get(type(error)), instance=request.url.path)


def install(app: FastAPI) -> None:
    """Respond with problem details to every error of the application."""

    @app.exception_handler(SpikedError)
    async def _spiked(request: Request, error: SpikedError) -> JSONResponse:
        return problem_of(error, request)

    @app.exception_handler(OSError)
    async def _system(request: Request, error: OSError) -> JSONResponse:
        if error.errno not in FULL:
            raise error  # unexpected
        return problem_of(StoreError("the disk is full, and nothing was changed: free disk space"), request)

    @app.exception_handler(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        detail = "; ".join(_finding(one, request) for one in error.errors()[:10])
        return problem(HTTPStatus.UNPROCESSABLE_ENTITY, detail, instance=request.url.path)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        code = HTTPStatus(error.status_code)
        detail, advice, headers = str(error.detail), None, {**(error.headers or {})}
        if detail == code.phrase and code is HTTPStatus.NOT_FOUND:
            detail, advice = f"there is no resource at {request.url.path}", "see /docs for all operations"
        elif detail == code.phrase and code is HTTPStatus.METHOD_NOT_ALLOWED:
            detail = f"{request.url.path} does not support {request.method}"
            headers["Allow"] = ", ".join(allowed_methods(app.openapi(), request.url.path)) or headers.get(
                "Allow", "GET"
            )
        return problem(code, detail, headers, instance=request.url.path, what_to_do=advice)

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> JSONResponse:
        return problem(
            HTTPStatus.INTERNAL_SERVER_ERROR,
            "the service failed to process the request; see its log",
            instance=request.url.path,
            what_to_do="report it with the lines of the log",
        )


def _finding(error: Any, request: Request) -> str:
    """One error of Pydantic: the field, the reason, and the given value if it is short."""
    given = error.get("input")
    if error["type"] == "json_invalid":
        return f"the body is not JSON: {error['ctx']['error']} (character {error['loc'][-1]})"
    if isinstance(given, bytes):  # FastAPI does not parse a body without a JSON content type
        sent = request.headers.get("content-type", "nothing")[:60]
        return f"the body was sent as {sent}, not as JSON: add the header content-type: application/json"
    where = ".".join(str(part) for part in error["loc"] if part != "body") or "body"
    if error["type"] == "extra_forbidden":
        return f"{where}: there is no such field{_nearest(request, error['loc'])}"
    shown = f", not {given!r}" if isinstance(given, str | int | float) and len(repr(given)) < 60 else ""
    return f"{where}: {str(error['msg']).removeprefix('Value error, ')}{shown}"


def _nearest(request: Request, place: tuple[str | int, ...]) -> str:
    """The field of the route's body with the most similar name, for a field that does not exist."""
    field = getattr(request.scope.get("route"), "body_field", None)
    schema = TypeAdapter(field.field_info.annotation).json_schema() if field is not None else {}
    node: Any = schema
    for part in place[1:-1]:
        node = _resolved(node, schema).get("properties", {}).get(part, {})
    found = get_close_matches(str(place[-1]), _resolved(node, schema).get("properties", {}), n=1)
    return f"; did you mean {found[0]}?" if found else ""


def _resolved(node: Any, schema: dict[str, Any]) -> dict[str, Any]:
    """The object schema that a node of a JSON schema refers to; empty if it refers to none."""
    for choice in node.get("anyOf", [node]):
        name = choice.get("$ref", "").removeprefix("#/$defs/")
        found: dict[str, Any] = schema.get("$defs", {}).get(name, choice)
        if "properties" in found:
            return found
    return {}


_SCHEMA = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
_DESCRIPTIONS = {
    400: "The request is malformed.",
    401: "A token is required.",
    403: "The scope of the token does not allow it.",
    404: "It does not exist, or not yet.",
    405: "The method is not supported.",
    409: "It conflicts with the current state.",
    413: "The body is larger than allowed.",
    415: "The content type is not supported.",
    416: "The range lies outside the file.",
    422: "A value of the request is invalid.",
    429: "Too many requests.",
    503: "The service is overloaded, or stops.",
    507: "The disk is full, or the catalogue cannot be written.",
}
_ALWAYS = (401, 403, 422, 429, 503)
"""Status codes that every route may answer."""
_Responses = dict[int | str, dict[str, Any]]


def problems(*codes: int) -> _Responses:
    """The documented problems of a route: these status codes, and those of every route."""
    return {
        code: {"description": _DESCRIPTIONS[code], "content": _SCHEMA} for code in sorted({*codes, *_ALWAYS, 400, 413})
    }
