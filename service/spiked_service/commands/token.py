"""`spiked token`: who may use the service."""

from datetime import timedelta
from pathlib import Path
from typing import Annotated

import typer

from spiked_service.config import load_settings
from spiked_service.console import messages, output
from spiked_service.store.folder import default_folder
from spiked_service.tokens import Tokens

token = typer.Typer(help="Tokens that open the service.", no_args_is_help=True)

_Data = Annotated[Path | None, typer.Option("--data", help="Data folder of the service.")]
_Config = Annotated[Path | None, typer.Option("--config", help="TOML file instead of the usual ones.")]


@token.command()
def create(
    name: Annotated[str, typer.Argument(help="Whom or what it is for.")],
    days: Annotated[float | None, typer.Option(help="Days until it expires.", min=0)] = None,
    data: _Data = None,
    config: _Config = None,
) -> None:
    """Make a token and print it, once: only its hash is kept."""
    secret = _tokens(data, config).create(name, None if days is None else timedelta(days=days))
    output.print(secret, markup=False)
    messages.print("Keep it now: it is not shown again. Send it as `Authorization: Bearer TOKEN`.", markup=False)


@token.command(name="list")
def list_(data: _Data = None, config: _Config = None) -> None:
    """The names of the tokens, when they were made, and until when they last."""
    for one in _tokens(data, config).all():
        until = f"until {one.expires_at:%Y-%m-%d %H:%M}" if one.expires_at else "until revoked"
        output.print(f"{one.name}  made {one.created_at:%Y-%m-%d %H:%M}  {until}", markup=False)


@token.command()
def revoke(name: str, data: _Data = None, config: _Config = None) -> None:
    """Make a token worthless, for a running service too."""
    _tokens(data, config).revoke(name)


def _tokens(data: Path | None, config: Path | None) -> Tokens:
    return Tokens(load_settings({"data": data}, config).settings.data or default_folder())
