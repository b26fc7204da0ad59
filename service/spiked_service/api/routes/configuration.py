"""`configuration` and `tokens`: the settings in effect and the tokens of the service."""

from datetime import datetime
from typing import Any

from fastapi import APIRouter
from pydantic import BaseModel, Field

from spiked_service.api.auth.scopes import needs
from spiked_service.api.problems import problems
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.settings import SettingOrigin, field, reloadable
from spiked_service.settings.tokens import Scope, Tokens


class SettingOut(BaseModel):
    """One setting; secrets are masked."""

    key: str = Field(examples=["limit_renders"])
    value: Any = Field(examples=[8])
    origin: SettingOrigin
    reloadable: bool = Field(description="Whether `configuration:reload` brings a new value into effect.")
    doc: str


class SettingsOut(BaseModel):
    """All settings in effect."""

    items: list[SettingOut]


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


class TokensOut(BaseModel):
    """All tokens, oldest first."""

    items: list[TokenOut]


def configuration_routes(settings: ReloadableSettings, tokens: Tokens) -> APIRouter:
    """`configuration` and `tokens`."""
    router = APIRouter(tags=["operations"])

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
                doc=field(name).description or "",
            )
            for name, value in configuration.shown().items()
        ]
        return SettingsOut(items=items)

    @router.post("/configuration:reload", responses=problems(), openapi_extra=needs(Scope.ADMIN))
    def reload_configuration() -> ReloadedOut:
        """Read file and environment again, as SIGHUP does. An error changes nothing."""
        done = settings.reload()
        return ReloadedOut(changed=done.changed, needs_restart=done.waiting)

    @router.get("/tokens", responses=problems(), openapi_extra=needs(Scope.ADMIN))
    def list_tokens() -> TokensOut:
        """Names and dates of the tokens; `spiked token` creates and revokes them."""
        items = [
            TokenOut(name=token.name, created_at=token.created_at, expires_at=token.expires_at, scope=token.scope)
            for token in tokens.all()
        ]
        return TokensOut(items=items)

    return router
