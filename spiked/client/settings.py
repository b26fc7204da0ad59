"""The settings and tokens of the service, for a token of scope `admin`."""

from collections.abc import Mapping
from urllib.parse import quote

from spiked.client.connection import Connection, plain
from spiked.client.models import (
    NewTokenOut,
    ReloadedOut,
    Scope,
    SettingsChange,
    SettingsOut,
    TokenOut,
    TokenRequest,
    TokensOut,
)


class SettingMethods:
    """What `Spiked` does with settings and tokens."""

    _connection: Connection

    def configuration(self) -> SettingsOut:
        """All settings in effect, and where each value is from; secrets are masked."""
        return self._connection.get("configuration", SettingsOut)

    def change_configuration(self, values: Mapping[str, bool | int | float | str | None]) -> ReloadedOut:
        """Change settings in the file of the service; None takes one out of it, which leaves its default.

        Return what is in effect and what needs a restart.
        """
        body = SettingsChange(values=dict(values)).model_dump(mode="json")
        return self._connection.change("PATCH", "configuration", body, ReloadedOut)

    def reload_configuration(self) -> ReloadedOut:
        """Have the service read its file and environment again."""
        return self._connection.post("configuration:reload", None, ReloadedOut)

    def tokens(self) -> list[TokenOut]:
        """Names, scopes and dates of the tokens, oldest first."""
        return self._connection.get("tokens", TokensOut).items

    def create_token(self, name: str, scope: Scope = Scope.read, *, days: float | None = None) -> NewTokenOut:
        """Make a token, valid so long or as long as the one of this client; only this answer has its `secret`."""
        return self._connection.post("tokens", plain(TokenRequest(name=name, scope=scope, days=days)), NewTokenOut)

    def revoke_token(self, name: str) -> None:
        """Revoke a token, and end what it has opened."""
        self._connection.request("DELETE", f"tokens/{quote(name, safe='')}")
