"""The flags of commands that work in the data folder of the service."""

from pathlib import Path
from typing import Annotated

import typer

from spiked_service.settings.settings import load_settings
from spiked_service.store.folder import default_folder

Data = Annotated[Path | None, typer.Option("--data", help="Data folder of the service.")]
Config = Annotated[Path | None, typer.Option("--config", help="TOML file, instead of the default files.")]


def data_folder(data: Path | None, config: Path | None) -> Path:
    """The named folder, or that of the settings, or the default one. Raises ConfigurationError."""
    return (load_settings({"data": data}, config).settings.data or default_folder()).absolute()
