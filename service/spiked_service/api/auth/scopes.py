"""Scopes of routes: `read` for safe methods, `operate` for others, unless the route declares its own."""

from typing import Any

from starlette.requests import HTTPConnection

from spiked_service.api.problems import ForbiddenError
from spiked_service.settings.tokens import Scope

_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})


def needs(scope: Scope) -> dict[str, Any]:
    """`openapi_extra` of a route whose scope differs from that of its method; it is documented and enforced."""
    return {"security": security(scope)}


def security(scope: Scope) -> list[dict[str, list[str]]]:
    """The security requirement in OpenAPI: none if the service requires no token, else a token with the scope."""
    return [{}, {"token": [scope.value]}]


def scope_of(method: str, declared: list[dict[str, list[str]]] | None) -> Scope:
    """The scope of an operation: of the `security` that it declares, else of its method."""
    for requirement in declared or []:
        if requirement.get("token"):
            return Scope(requirement["token"][0])
    return Scope.READ if method.upper() in _SAFE else Scope.OPERATE


async def authorise(connection: HTTPConnection) -> None:
    """A dependency of every route of the API. Raises ForbiddenError if the token's scope does not allow the route."""
    caller = connection.scope["state"]["caller"]
    extra = getattr(connection.scope["route"], "openapi_extra", None) or {}
    needed = scope_of(connection.scope.get("method", "GET"), extra.get("security"))
    if not caller.scope.allows(needed):
        raise ForbiddenError(
            f"the token {caller.name} has scope {caller.scope}, this request needs {needed}: use another token; "
            f"`spiked token create NAME --scope {needed}` makes one"
        )
