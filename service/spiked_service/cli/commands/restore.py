"""`spiked restore`: a copy of the catalogue takes its place."""

from pathlib import Path
from typing import Annotated

import typer

from spiked_service.cli.console import output
from spiked_service.cli.data_folder import Config, Data, data_folder
from spiked_service.store.backup import restore as restore_catalogue
from spiked_service.store.folder import DataFolder


def restore(
    file: Annotated[
        Path | None,
        typer.Argument(help="A copy of the catalogue. Default: the newest in `backups`.", show_default=False),
    ] = None,
    data: Data = None,
    config: Config = None,
) -> None:
    """Replace the catalogue of a data folder by a copy. Stop the service first.

    The old catalogue is kept. Rows newer than the copy are rebuilt from the files when the service starts.

    Example: `spiked restore`
    """
    folder = DataFolder(data_folder(data, config))
    try:
        restored, before = restore_catalogue(folder, file)
    finally:
        folder.close()
    output.print(f"restored {restored}", markup=False)
    if before is not None:
        output.print(f"the old catalogue is kept as {before}", markup=False)
