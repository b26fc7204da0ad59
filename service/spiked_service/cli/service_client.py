"""The client of commands that talk to a running service."""

import os
from pathlib import Path
from typing import Annotated

import typer

from spiked.client import Spiked
from spiked.errors import ConfigurationError
from spiked_service.cli.commands.health import address_of
from spiked_service.settings.settings import load_settings

Address = Annotated[
    str | None,
    typer.Option(help="Address of the service. Default: $SPIKED_ADDRESS, or that of the settings.", show_default=False),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        help="File with a token of the service. Default: $SPIKED_CLIENT_TOKEN, if it is set.", show_default=False
    ),
]


def client(address: str | None, token_file: Path | None) -> Spiked:
    """A client of the service that is meant. Raises ConfigurationError."""
    where = address or os.environ.get("SPIKED_ADDRESS") or address_of(load_settings({}).settings)
    try:
        token = os.environ.get("SPIKED_CLIENT_TOKEN") if token_file is None else token_file.read_text().strip()
    except OSError as error:
        raise ConfigurationError(f"--token-file {token_file} cannot be read: {error.strerror}") from error
    return Spiked(where, token=token)
