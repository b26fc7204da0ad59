"""`spiked backup`: a copy of the catalogue."""

from pathlib import Path
from typing import Annotated

import typer

from spiked_service.cli import outputs
from spiked_service.cli.console import output
from spiked_service.cli.data_folder import Config, Data, data_folder
from spiked_service.store.backup import back_up
from spiked_service.store.catalogue import StoreError


def backup(
    to: Annotated[
        Path | None, typer.Option("--to", help="File to write. Default: a new file in `backups` of the data folder.")
    ] = None,
    data: Data = None,
    config: Config = None,
) -> None:
    """Copy the catalogue of a data folder. A service may be running.

    The copy is one consistent file. Copy recordings and results with another tool, for example rsync; see
    docs/backup.md.

    Example: `spiked backup && rsync -a --exclude 'catalogue.sqlite*' ~/.local/share/spiked/ nas:spiked/`
    """
    if to is not None:
        outputs.try_file("--to", to)
    folder = data_folder(data, config)
    catalogue = folder / "catalogue.sqlite"
    if not catalogue.is_file():
        raise StoreError(f"there is no catalogue in {folder}; give the data folder of the service with --data")
    output.print(str(back_up(catalogue, None if to is None else to.absolute())), markup=False)
