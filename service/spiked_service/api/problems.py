"""Errors as RFC 9457 problem details."""

from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from spiked.errors import SpikedError
from spiked_service.captures import BusyError, UnknownCaptureError
from spiked_service.limits import OverloadedError


class Problem(BaseModel):
    """RFC 9457 problem details."""

    type: str = Field("about:blank", examples=["about:blank"])
    title: str = Field(examples=["Conflict"])
    status: int = Field(examples=[409])
    detail: str = Field(examples=["capture 0192… is still running: stop it, or wait for its end"])


class NotReadyError(SpikedError):
    """What was asked for will exist later."""


_STATUS: dict[type[SpikedError], HTTPStatus] = {
    UnknownCaptureError: HTTPStatus.NOT_FOUND,
    BusyError: HTTPStatus.CONFLICT,
    NotReadyError: HTTPStatus.NOT_FOUND,
    OverloadedError: HTTPStatus.SERVICE_UNAVAILABLE,
}


def problem(status: HTTPStatus | int, detail: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """A response that says what is wrong."""
    code = HTTPStatus(status)
    body = Problem(type="about:blank", title=code.phrase, status=code.value, detail=detail)
    return JSONResponse(body.model_dump(), code.value, headers, "application/problem+json")


def install(app: FastAPI) -> None:
    """Answer every error of the application with problem details."""

    @app.exception_handler(SpikedError)
    def _spiked(request: Request, error: SpikedError) -> JSONResponse:
        return problem(_STATUS.get(type(error), HTTPStatus.UNPROCESSABLE_ENTITY), str(error))

    @app.exception_handler(RequestValidationError)
    def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        told = "; ".join(f"{'.'.join(str(part) for part in e['loc'])}: {e['msg']}" for e in error.errors())
        return problem(HTTPStatus.UNPROCESSABLE_ENTITY, told)

    @app.exception_handler(HTTPException)
    def _http(request: Request, error: HTTPException) -> JSONResponse:
        return problem(error.status_code, str(error.detail), dict(error.headers or {}))
