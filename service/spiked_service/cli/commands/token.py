"""`spiked token`: access tokens of the service."""

from datetime import timedelta
from pathlib import Path
from typing import Annotated

import typer

from spiked_service.cli.console import messages, output
from spiked_service.cli.data_folder import Config, Data, data_folder
from spiked_service.settings.settings import MOST_DAYS
from spiked_service.settings.tokens import Scope, Tokens

token = typer.Typer(help="Access tokens of the service.", no_args_is_help=True)


@token.command()
def create(
    name: Annotated[str, typer.Argument(help="Name of the token, such as its user or device.")],
    days: Annotated[
        float | None, typer.Option(help="Days until it expires. Default: never.", min=0, max=MOST_DAYS)
    ] = None,
    scope: Annotated[
        Scope,
        typer.Option(
            help="read: view and download. operate: also start, change and remove captures. admin: also settings."
        ),
    ] = Scope.ADMIN,
    data: Data = None,
    config: Config = None,
) -> None:
    """Create a token and print it. Only its hash is stored, so it cannot be printed again."""
    secret = _tokens(data, config).create(name, None if days is None else timedelta(days=days), scope)
    output.print(secret, markup=False)
    messages.print("Store it now: it is not shown again. Send it as `Authorization: Bearer TOKEN`.", markup=False)


@token.command(name="list")
def list_(data: Data = None, config: Config = None) -> None:
    """List the tokens: name, scope, creation and expiry. Secrets are not stored."""
    for one in _tokens(data, config).all():
        until = f"until {one.expires_at:%Y-%m-%d %H:%M}" if one.expires_at else "until revoked"
        output.print(f"{one.name}  {one.scope}  created {one.created_at:%Y-%m-%d %H:%M}  {until}", markup=False)


@token.command()
def revoke(name: str, data: Data = None, config: Config = None) -> None:
    """Revoke a token. A running service closes its streams within a second."""
    _tokens(data, config).revoke(name)


def _tokens(data: Path | None, config: Path | None) -> Tokens:
    return Tokens(data_folder(data, config))
