"""Requests to one service: where, as whom, sent again when that is safe, errors told as the service tells them."""

import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from spiked.client.models import Problem
from spiked.errors import SpikedError

_Model = TypeVar("_Model", bound=BaseModel)
_TRIES = 4
"""Attempts of a request in all, ..."""
_PAUSE_S = 0.25
"""... and the pause after the first, seconds; it doubles with each."""
_AGAIN = frozenset({429, 503})


class ApiError(SpikedError):
    """The service refused a request; `problem` says why, and what to do."""

    def __init__(self, problem: Problem) -> None:
        advice = f"; {problem.what_to_do}" if problem.what_to_do else ""
        super().__init__(f"{problem.detail}{advice}")
        self.problem = problem

    @property
    def status(self) -> int:
        """Of HTTP."""
        return self.problem.status


class ServiceUnreachableError(SpikedError):
    """There is no answer at the service's address."""


class Connection:
    """Speaks with the service. Usable from any thread."""

    def __init__(self, address: str, token: str | None, timeout_s: float) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=f"{address.rstrip('/')}/api/v1/", headers=headers, timeout=timeout_s)

    def close(self) -> None:
        """Let go of the connections."""
        self._http.close()

    def get(self, path: str, model: type[_Model], /, **query: Any) -> _Model:
        """A model from a GET. Raises ApiError, ServiceUnreachableError."""
        return _read(self.request("GET", path, query=query), model)

    def post(self, path: str, body: Mapping[str, Any] | None, model: type[_Model]) -> _Model:
        """A model from a POST, which works once however often it must be sent. Raises as `get`."""
        return _read(self.request("POST", path, json=body, headers={"Idempotency-Key": uuid.uuid4().hex}), model)

    def change(self, method: str, path: str, body: Mapping[str, Any] | None, model: type[_Model]) -> _Model:
        """A model from a PATCH, PUT or DELETE. Raises as `get`."""
        return _read(self.request(method, path, json=body), model)

    def request(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Any] | None = None,
        json: Any = None,
        content: bytes | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        """One answer. Sent again after a broken connection, and when the service is too busy. Raises as `get`."""
        asked = {name: value for name, value in (query or {}).items() if value is not None}
        url = f"/{path}"  # without the slash, what is before the colon of `configuration:reload` were a scheme
        for attempt in range(_TRIES):
            last = attempt == _TRIES - 1
            try:
                answer = self._http.request(
                    method, url, params=asked, json=json, content=content, headers=dict(headers or {})
                )
            except httpx.TransportError as error:
                if last or isinstance(error, httpx.ConnectError | httpx.ReadTimeout):
                    raise ServiceUnreachableError(
                        f"no answer from {self._http.base_url}: {error}; {_what_to_do(error)}"
                    ) from error
            else:
                if answer.status_code not in _AGAIN or last:
                    return _checked(answer)
            time.sleep(_PAUSE_S * 2**attempt)
        raise AssertionError("the last attempt returns or raises")

    @contextmanager
    def stream(self, path: str, headers: Mapping[str, str] | None = None, **query: Any) -> Iterator[httpx.Response]:
        """An answer that comes bit by bit, without an end to its patience. Raises as `get`."""
        asked = {name: value for name, value in query.items() if value is not None}
        try:
            with self._http.stream("GET", path, params=asked, headers=dict(headers or {}), timeout=None) as answer:
                if answer.is_error:
                    answer.read()
                yield _checked(answer)
        except httpx.TransportError as error:
            raise ServiceUnreachableError(f"the stream {path} broke off: {error}; ask again") from error


def _what_to_do(error: httpx.TransportError) -> str:
    if "CERTIFICATE_VERIFY_FAILED" in str(error):
        return "set SSL_CERT_FILE to the file of its certificate, and use a name that this holds"
    return "look whether `spiked serve` runs there"


def _checked(answer: httpx.Response) -> httpx.Response:
    if not answer.is_error:
        return answer
    try:
        raise ApiError(Problem.model_validate_json(answer.content))
    except ValidationError:
        detail = f"{answer.request.url} answered {answer.status_code} {answer.reason_phrase}"
    raise ApiError(
        Problem(
            type="about:blank",
            title=answer.reason_phrase,
            status=answer.status_code,
            detail=detail,
            instance=None,
            what_to_do="look whether this is the address of a spiked service",
        )
    )


def _read(answer: httpx.Response, model: type[_Model]) -> _Model:
    try:
        return model.model_validate_json(answer.content)
    except ValidationError as error:
        raise SpikedError(
            f"{answer.request.url} answered something else than this client expects; use the client of the service's "
            f"version: {error.errors()[0]['msg']}"
        ) from error


def plain(model: BaseModel | None) -> Mapping[str, Any] | None:
    """A model as JSON has it, without fields that are not set."""
    return None if model is None else model.model_dump(mode="json", exclude_none=True)
