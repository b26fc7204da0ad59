"""`spiked config`: what the service would run with, and why."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from spiked_service.config import field, load_settings, reloadable, setting
from spiked_service.console import output

config = typer.Typer(help="Settings of the service.", no_args_is_help=True)


@config.command()
def show(
    file: Annotated[Path | None, typer.Option("--config", help="TOML file instead of the usual ones.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="NAME=VALUE, as for `spiked serve`.")] = None,
    meaning: Annotated[bool, typer.Option("--meaning", help="With what each setting means.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Every setting with its value, where the value comes from, and whether SIGHUP brings a new one into effect."""
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
        told = [field(name).description] if meaning else []
        table.add_row(name, text, configuration.origins[name], "yes" if reloadable(name) else "", *told)
    output.print(table)
