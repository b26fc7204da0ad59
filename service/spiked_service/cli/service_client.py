"""The client of commands that talk to a running service, and their options."""

import os
from pathlib import Path
from typing import Annotated

import typer

from spiked.client import Spiked
from spiked_service.cli.commands.health import address_of
from spiked_service.settings.settings import load_settings
from spiked_service.settings.tokens import chosen_token

Address = Annotated[
    str | None,
    typer.Option(help="Address of the service. Default: $SPIKED_ADDRESS, or that of the settings.", show_default=False),
]
Token = Annotated[
    str | None,
    typer.Option(
        help="Token of the service. Users of this machine see it in the list of processes: better set "
        "SPIKED_CLIENT_TOKEN or SPIKED_TOKEN, or give a file.",
        show_default=False,
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        help="File that holds the token. Default: $SPIKED_TOKEN_FILE, if none of these is set.", show_default=False
    ),
]


def client(address: str | None, token: str | None, token_file: Path | None) -> Spiked:
    """A client of the service that is meant, with the token of the options, else that of the environment.

    Raises ConfigurationError.
    """
    where = address or os.environ.get("SPIKED_ADDRESS") or address_of(load_settings({}).settings)
    given = chosen_token(token, token_file) or os.environ.get("SPIKED_CLIENT_TOKEN") or _of_the_service()
    return Spiked(where, token=given)


def _of_the_service() -> str | None:
    """The token that the environment has for a service on this machine."""
    file = os.environ.get("SPIKED_TOKEN_FILE")
    return chosen_token(os.environ.get("SPIKED_TOKEN") or None, Path(file) if file else None)
