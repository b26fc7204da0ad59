"""`spiked backup` and `spiked restore`: copies of the catalogue."""

from pathlib import Path
from typing import Annotated

import typer

from spiked_service.cli import outputs
from spiked_service.cli.console import output
from spiked_service.settings.settings import load_settings
from spiked_service.store.backup import back_up
from spiked_service.store.backup import restore as restore_catalogue
from spiked_service.store.catalogue import StoreError
from spiked_service.store.folder import DataFolder, default_folder

_Data = Annotated[Path | None, typer.Option("--data", help="Data folder of the service.")]
_Config = Annotated[Path | None, typer.Option("--config", help="TOML file, instead of the default files.")]


def backup(
    to: Annotated[
        Path | None, typer.Option("--to", help="File to write. Default: a new file in `backups` of the data folder.")
    ] = None,
    data: _Data = None,
    config: _Config = None,
) -> None:
    """Copy the catalogue of a data folder. A service may be running.

    The copy is one consistent file. Copy recordings and results with another tool, for example rsync; see
    docs/backup.md.

    Example: `spiked backup && rsync -a --exclude 'catalogue.sqlite*' ~/.local/share/spiked/ nas:spiked/`
    """
    if to is not None:
        outputs.try_file("--to", to)
    folder = _folder(data, config)
    catalogue = folder / "catalogue.sqlite"
    if not catalogue.is_file():
        raise StoreError(f"there is no catalogue in {folder}; give the data folder of the service with --data")
    output.print(str(back_up(catalogue, None if to is None else to.absolute())), markup=False)


def restore(
    file: Annotated[
        Path | None,
        typer.Argument(help="A copy of the catalogue. Default: the newest in `backups`.", show_default=False),
    ] = None,
    data: _Data = None,
    config: _Config = None,
) -> None:
    """Replace the catalogue of a data folder by a copy. Stop the service first.

    The old catalogue is kept. Rows newer than the copy are rebuilt from the files when the service starts.

    Example: `spiked restore`
    """
    folder = DataFolder(_folder(data, config))
    try:
        restored, before = restore_catalogue(folder, file)
    finally:
        folder.close()
    output.print(f"restored {restored}", markup=False)
    if before is not None:
        output.print(f"the old catalogue is kept as {before}", markup=False)


def _folder(data: Path | None, config: Path | None) -> Path:
    return (load_settings({"data": data}, config).settings.data or default_folder()).absolute()
