"""`spiked config`: the settings that the service would use, with their origins."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from spiked_service.cli.commands.version import renderer
from spiked_service.cli.console import output
from spiked_service.settings.settings import field, load_settings, pass_on, reloadable, setting

config = typer.Typer(help="Settings of the service.", no_args_is_help=True)


@config.command()
def show(
    file: Annotated[Path | None, typer.Option("--config", help="TOML file, instead of the default files.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="NAME=VALUE, as for `spiked serve`.")] = None,
    meaning: Annotated[bool, typer.Option("--meaning", help="Also print the meaning of each setting.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print every setting with its value, its origin, and whether a reload (SIGHUP) applies a new value."""
    configuration = load_settings(dict(setting(text) for text in set_ or []), file)
    values = configuration.shown()
    if as_json:
        rows = [
            {
                "key": name,
                "value": value,
                "origin": configuration.origins[name],
                "reloadable": reloadable(name),
                "doc": field(name).description,
            }
            for name, value in values.items()
        ]
        output.print(json.dumps(rows, indent=2), markup=False)
        return
    output.print(f"file: {configuration.file or 'none'}", markup=False)
    table = Table(box=None, pad_edge=False)
    for heading in ("setting", "value", "from", "reload", *(["meaning"] if meaning else [])):
        table.add_column(heading, overflow="fold")
    for name, value in values.items():
        text = "" if value is None else json.dumps(value) if isinstance(value, list | bool) else str(value)
        meanings = [field(name).description] if meaning else []
        table.add_row(name, text, configuration.origins[name], "yes" if reloadable(name) else "", *meanings)
    output.print(table)
    pass_on(configuration.settings)
    output.print(f"renderer: {renderer()}", markup=False)
