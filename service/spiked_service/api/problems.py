"""Errors as RFC 9457 problem details that say what is wrong and what to do."""

from difflib import get_close_matches
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from starlette.exceptions import HTTPException

from spiked.errors import SpikedError
from spiked_service.api.paths import allowed_methods
from spiked_service.errors import BusyError
from spiked_service.limits import OverloadedError
from spiked_service.pictures import FrameNotRecordedError
from spiked_service.store.catalogue import StoreError, UnknownIdError
from spiked_service.uploads import UploadBusyError, UploadError, UploadOffsetError, UploadTooLargeError

MEDIA_TYPE = "application/problem+json"
_RETRY_S = 1


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
                    "what_to_do": "look for the id with the GET of the list",
                }
            ]
        },
    )

    type: str = Field(description="urn:spiked:problem: and the kind of problem.")
    title: str
    status: int
    detail: str = Field(description="What is wrong, in one sentence or a few.")
    instance: str | None = Field(None, description="Path of the request.")
    what_to_do: str | None = Field(None, description="What will help, where something will.")


class NotReadyError(SpikedError):
    """What was asked for will exist later."""


class NoPoseError(SpikedError):
    """A time or frame has no pose, or none yet."""


class NothingError(SpikedError):
    """What was asked for is not there, and nothing is at work that would make it."""


class GoneError(SpikedError):
    """What was asked for is not kept."""


class ConflictError(SpikedError):
    """The request does not fit the state that things are in."""


class UnsupportedTypeError(SpikedError):
    """A body of a type that is not taken."""


class KeyReusedError(SpikedError):
    """An idempotency key came with another request than before."""


_STATUS: dict[type[SpikedError], HTTPStatus] = {
    UnknownIdError: HTTPStatus.NOT_FOUND,
    NotReadyError: HTTPStatus.NOT_FOUND,
    NoPoseError: HTTPStatus.NOT_FOUND,
    NothingError: HTTPStatus.NOT_FOUND,
    GoneError: HTTPStatus.NOT_FOUND,
    FrameNotRecordedError: HTTPStatus.NOT_FOUND,
    BusyError: HTTPStatus.CONFLICT,
    UploadBusyError: HTTPStatus.CONFLICT,
    UploadTooLargeError: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    UploadOffsetError: HTTPStatus.CONFLICT,
    UploadError: HTTPStatus.CONFLICT,
    UnsupportedTypeError: HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
    ConflictError: HTTPStatus.CONFLICT,
    OverloadedError: HTTPStatus.SERVICE_UNAVAILABLE,
    StoreError: HTTPStatus.INSUFFICIENT_STORAGE,
}

_KINDS: dict[type[SpikedError], str] = {
    NotReadyError: "not-ready",
    NoPoseError: "no-pose",
    NothingError: "nothing-there",
    GoneError: "gone",
    FrameNotRecordedError: "not-recorded",
    BusyError: "busy",
    KeyReusedError: "idempotency-key-reused",
}

_WHAT_TO_DO: dict[int, str] = {
    400: "send a request as /openapi.json describes it",
    401: "send Authorization: Bearer TOKEN; `spiked token create NAME` makes one",
    404: "look for the id with the GET of the list",
    405: "use a method that the Allow header names",
    408: "send the request again, without long pauses in its body",
    409: "look at the state of the thing with GET, and ask again when it fits",
    411: "send Content-Length",
    413: "send less at a time; recordings go through uploads, in chunks",
    415: "send the body with the Content-Type that /openapi.json names",
    416: "ask for a range that begins inside the file",
    422: "mend what the detail names; /openapi.json and /docs show what is expected",
    429: "wait as long as Retry-After says",
    503: "ask again in a moment, as Retry-After says",
    507: "make room in the data folder, or remove captures",
}

_MORE: dict[str, str] = {
    "not-ready": "ask again in a moment, or wait for the event that tells of it",
    "no-pose": "ask for a time or frame that the detail names, or again when more is tracked",
    "nothing-there": "do as the detail says",
    "gone": "ask for a newer version; GET versions lists those that are kept",
    "not-recorded": "ask for a frame that the detail names",
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
    """A response that says what is wrong."""
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
    """The response to one of our own errors."""
    status = next((_STATUS[kind] for kind in type(error).__mro__ if kind in _STATUS), HTTPStatus.UNPROCESSABLE_ENTITY)
    headers = {"Retry-After": str(_RETRY_S)} if status is HTTPStatus.SERVICE_UNAVAILABLE else {}
    if isinstance(error, UploadOffsetError):
        headers["Upload-Offset"] = str(error.offset_bytes)
    return problem(status, str(error), headers, kind=_KINDS.get(type(error)), instance=request.url.path)


def install(app: FastAPI) -> None:
    """Answer every error of the application with problem details."""

    @app.exception_handler(SpikedError)
    async def _spiked(request: Request, error: SpikedError) -> JSONResponse:
        return problem_of(error, request)

    @app.exception_handler(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        told = "; ".join(_told(one, request) for one in error.errors()[:10])
        return problem(HTTPStatus.UNPROCESSABLE_ENTITY, told, instance=request.url.path)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        code = HTTPStatus(error.status_code)
        detail, advice, headers = str(error.detail), None, {**(error.headers or {})}
        if detail == code.phrase and code is HTTPStatus.NOT_FOUND:
            detail, advice = f"there is nothing at {request.url.path}", "/docs lists what there is"
        elif detail == code.phrase and code is HTTPStatus.METHOD_NOT_ALLOWED:
            detail = f"{request.url.path} does not take {request.method}"
            headers["Allow"] = ", ".join(allowed_methods(app.openapi(), request.url.path)) or headers.get(
                "Allow", "GET"
            )
        return problem(code, detail, headers, instance=request.url.path, what_to_do=advice)

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> JSONResponse:
        return problem(
            HTTPStatus.INTERNAL_SERVER_ERROR,
            "the service failed over this request; its log says more",
            instance=request.url.path,
            what_to_do="report it with the log lines of this moment",
        )


def _told(error: Any, request: Request) -> str:
    """One finding of Pydantic: where, what, and what came, if that is short."""
    given = error.get("input")
    if error["type"] == "json_invalid":
        return f"the body is not JSON: {error['ctx']['error']} (character {error['loc'][-1]})"
    if isinstance(given, bytes):  # FastAPI does not look into a body that is not said to be JSON
        sent = request.headers.get("content-type", "nothing")[:60]
        return f"the body was sent as {sent}, not as JSON: add the header content-type: application/json"
    where = ".".join(str(part) for part in error["loc"] if part != "body") or "body"
    if error["type"] == "extra_forbidden":
        return f"{where}: there is no such field{_nearest(request, error['loc'])}"
    shown = f", not {given!r}" if isinstance(given, str | int | float) and len(repr(given)) < 60 else ""
    return f"{where}: {str(error['msg']).removeprefix('Value error, ')}{shown}"


def _nearest(request: Request, place: tuple[str | int, ...]) -> str:
    """The field of the route's body that was probably meant, for one that does not exist."""
    field = getattr(request.scope.get("route"), "body_field", None)
    schema = TypeAdapter(field.field_info.annotation).json_schema() if field is not None else {}
    node: Any = schema
    for part in place[1:-1]:
        node = _resolved(node, schema).get("properties", {}).get(part, {})
    found = get_close_matches(str(place[-1]), _resolved(node, schema).get("properties", {}), n=1)
    return f"; did you mean {found[0]}?" if found else ""


def _resolved(node: Any, schema: dict[str, Any]) -> dict[str, Any]:
    """The object that a node of a JSON schema stands for, where it stands for one."""
    for choice in node.get("anyOf", [node]):
        name = choice.get("$ref", "").removeprefix("#/$defs/")
        found: dict[str, Any] = schema.get("$defs", {}).get(name, choice)
        if "properties" in found:
            return found
    return {}


_SCHEMA = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
_DESCRIPTIONS = {
    400: "The request cannot be read.",
    401: "A token is needed.",
    404: "There is no such thing, or not yet.",
    405: "It does not take this method.",
    409: "It does not fit the state that things are in.",
    413: "The body is larger than allowed.",
    415: "The body is of another type.",
    416: "The range lies outside the file.",
    422: "Something in the request cannot be.",
    429: "Too many requests.",
    503: "Too busy, or about to end.",
    507: "The disk is full, or the catalogue cannot be written.",
}
_ALWAYS = (401, 422, 429, 503)
_Responses = dict[int | str, dict[str, Any]]


def problems(*codes: int) -> _Responses:
    """The responses of a route with these problems, and those that every route may have."""
    return {
        code: {"description": _DESCRIPTIONS[code], "content": _SCHEMA} for code in sorted({*codes, *_ALWAYS, 400, 413})
    }
