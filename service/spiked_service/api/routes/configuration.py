"""`configuration` and `tokens`: the settings in effect and the tokens of the service."""

from datetime import datetime, timedelta
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, Field, StrictBool, StrictFloat, StrictInt, StrictStr

from spiked.errors import ConfigurationError
from spiked_service.api.auth.scopes import needs
from spiked_service.api.auth.security import Caller
from spiked_service.api.problems import ForbiddenError, problems
from spiked_service.api.routes.options import whole
from spiked_service.api.schemas.base import In, example
from spiked_service.events.logging import AUDIT, logger
from spiked_service.settings.editing import EDITABLE
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.settings import MOST_DAYS, SettingOrigin, Settings, field, own_file, reloadable
from spiked_service.settings.tokens import Scope, Tokens
from spiked_service.store.catalogue import UnknownIdError

_log = logger(AUDIT)
_LONGEST_NAME = 64
"""Characters of a token's name."""
TokenName = Annotated[str, Field(pattern=rf"^[A-Za-z0-9][A-Za-z0-9._-]{{0,{_LONGEST_NAME - 1}}}$")]


class SettingOut(BaseModel):
    """One setting; secrets are masked."""

    key: str = Field(examples=["limit_renders"])
    value: Any = Field(examples=[8])
    origin: SettingOrigin
    reloadable: bool = Field(description="Whether `configuration:reload` brings a new value into effect.")
    editable: bool = Field(description="Whether `PATCH configuration` changes it; others are changed in the file.")
    option: dict[str, Any] = Field(description="JSON Schema: type, limits, default, meaning.")
    doc: str


class SettingsOut(BaseModel):
    """All settings in effect."""

    items: list[SettingOut]
    file: str = Field(description="The file that `PATCH configuration` changes.")
    needs_restart: list[str] = Field(description="Settings whose value in the file takes effect after a restart.")
    problem: str | None = Field(description="Why the file as it is now cannot be loaded; null if it can be.")


class SettingsChange(In):
    """New values of settings."""

    model_config = example(values={"retention_days": 30, "log_level": "info"})

    values: dict[str, StrictBool | StrictInt | StrictFloat | StrictStr | None] = Field(
        min_length=1,
        max_length=64,
        description="By the names of `GET configuration`; null removes a setting from the file: its default.",
    )


class ReloadedOut(BaseModel):
    """Result of a reload."""

    changed: list[str] = Field(description="Settings whose new value is in effect.")
    needs_restart: list[str] = Field(description="Settings whose new value takes effect after a restart.")


class TokenOut(BaseModel):
    """A token, without its secret."""

    name: str
    created_at: datetime
    expires_at: datetime | None
    scope: Scope = Field(description="read: look and download; operate: change captures, too; admin: set-up, too.")
    created_by: str | None = Field(description="The token that it was created with; null: by `spiked token`.")


class TokensOut(BaseModel):
    """All tokens, oldest first."""

    items: list[TokenOut]


class TokenRequest(In):
    """A token to be made."""

    model_config = example(name="display", scope="read", days=90)

    name: TokenName = Field(description="Of its user or device.")
    scope: Scope
    days: StrictFloat | None = Field(
        None,
        gt=0,
        le=MOST_DAYS,
        description="Until it expires; null: when the token of this request does, if that expires.",
    )


class NewTokenOut(TokenOut):
    """A new token."""

    secret: str = Field(description="The token itself, which is not shown again: only its hash is kept.")


def configuration_routes(settings: ReloadableSettings, tokens: Tokens) -> APIRouter:
    """`configuration` and `tokens`."""
    router = APIRouter(tags=["operations"])
    schema = whole(Settings.model_json_schema())["properties"]

    @router.get("/configuration", responses=problems(), openapi_extra=needs(Scope.ADMIN))
    def get_configuration() -> SettingsOut:
        """Every setting in effect and the origin of its value."""
        configuration = settings.configuration
        items = [
            SettingOut(
                key=name,
                value=value,
                origin=configuration.origins[name],
                reloadable=reloadable(name),
                editable=name in EDITABLE,
                option=schema[name],
                doc=field(name).description or "",
            )
            for name, value in configuration.shown().items()
        ]
        try:
            waiting, trouble = settings.waiting(), None
        except ConfigurationError as error:
            waiting, trouble = [], str(error)
        file = str(configuration.file or own_file())
        return SettingsOut(items=items, file=file, needs_restart=waiting, problem=trouble)

    @router.patch("/configuration", responses=problems(), openapi_extra=needs(Scope.ADMIN))
    def change_configuration(body: SettingsChange, request: Request) -> ReloadedOut:
        """Change settings in the file that the service was started with, and reload it. An error changes nothing.

        Limits, retention, logs, workers and the choice of the renderer can be changed. Addresses, tokens, certificates,
        folders and devices are changed on the machine of the service only.
        """
        done = settings.change(body.values)
        caller: Caller = request.state.caller
        _log.info(
            "settings changed",
            values=body.values,
            caller=caller.name,
            address=caller.address,
            changed=done.changed,
            waiting=done.waiting,
        )
        return ReloadedOut(changed=done.changed, needs_restart=done.waiting)

    @router.post("/configuration:reload", responses=problems(), openapi_extra=needs(Scope.ADMIN))
    def reload_configuration() -> ReloadedOut:
        """Read file and environment again, as SIGHUP does. An error changes nothing."""
        done = settings.reload()
        return ReloadedOut(changed=done.changed, needs_restart=done.waiting)

    _add_token_routes(router, tokens)
    return router


def _add_token_routes(router: APIRouter, tokens: Tokens) -> None:
    """`tokens`."""

    @router.get("/tokens", responses=problems(), openapi_extra=needs(Scope.ADMIN))
    def list_tokens() -> TokensOut:
        """Names, scopes and dates of the tokens."""
        return TokensOut(items=[TokenOut.model_validate(one, from_attributes=True) for one in tokens.all()])

    @router.post("/tokens", status_code=HTTPStatus.CREATED, responses=problems(), openapi_extra=needs(Scope.ADMIN))
    def create_token(body: TokenRequest, request: Request, response: Response) -> NewTokenOut:
        """Make a token; this answer is the only one that has it.

        Only who brings a token of scope `admin` may, even where none is required: the first is made by `spiked token
        create`. A token ends no later than the one that it was made with.
        """
        caller = _signed_in(request)
        lifetime = None if body.days is None else timedelta(days=body.days)
        secret = tokens.create(body.name, lifetime, body.scope, by=caller.name)
        (made,) = (one for one in tokens.all() if one.name == body.name)
        _log.warning("token created", token=body.name, scope=body.scope, caller=caller.name, address=caller.address)
        response.headers["Cache-Control"] = "no-store"
        return NewTokenOut(secret=secret, **TokenOut.model_validate(made, from_attributes=True).model_dump())

    @router.delete(
        "/tokens/{name}", status_code=HTTPStatus.NO_CONTENT, responses=problems(404), openapi_extra=needs(Scope.ADMIN)
    )
    def revoke_token(name: TokenName, request: Request) -> None:
        """Revoke a token, and end what it has opened, within a second. Who may: see `POST tokens`."""
        caller = _signed_in(request)
        if all(one.name != name for one in tokens.all()):
            raise UnknownIdError(f"there is no token {name}; GET tokens lists them")
        tokens.revoke(name)
        _log.warning("token revoked", token=name, caller=caller.name, address=caller.address)


def _signed_in(request: Request) -> Caller:
    """Who brings a token of scope `admin`. Raises ForbiddenError for others, who may do all the rest on loopback.

    A token outlasts the settings: one that is made while none is required opens the service when one is.
    """
    caller: Caller = request.state.caller
    if caller.token_scope is not Scope.ADMIN:
        raise ForbiddenError(
            "tokens are made and revoked with a token of scope admin only, even where none is required: "
            "`spiked token create NAME` makes the first"
        )
    return caller
