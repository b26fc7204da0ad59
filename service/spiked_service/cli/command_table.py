"""The commands of `spiked` by name. A command's module is imported when it is asked for: all of them take seconds."""

from collections import UserDict
from importlib import import_module
from typing import Any

import typer
import typer.core

PANELS = {
    "Live": ("serve", "record", "devices", "health", "backup", "restore", "config", "token"),
    "Files": ("info", "verify", "cut", "convert", "offset", "simulate", "calibrate", "noise-report"),
    "Scenes": (
        *("reconstruct", "localise", "merge", "scale", "clean", "render", "evaluate", "report", "export"),
        *("baseline", "compare", "datasets", "video"),
    ),
    "This program": ("doctor", "bench", "openapi", "version"),
}
"""Names of commands by the panel of `spiked --help` that shows them, in its order."""


class _Commands(UserDict[str, Any]):
    """Commands of Typer, each made of the function or group of its name in the module of its name."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(name for names in PANELS.values() for name in names))

    def __getitem__(self, name: str) -> Any:
        if self.data[name] is None:
            self.data[name] = _loaded(name)
        return self.data[name]


def _loaded(name: str) -> Any:
    attribute = name.replace("-", "_")
    found = getattr(import_module(f"spiked_service.cli.commands.{attribute}"), attribute)
    panel = next(panel for panel, names in PANELS.items() if name in names)
    one = typer.Typer(rich_markup_mode="markdown", pretty_exceptions_enable=False)
    if isinstance(found, typer.Typer):
        one.add_typer(found, name=name, rich_help_panel=panel)
    else:
        one.command(name, rich_help_panel=panel)(found)
    return typer.main.get_group(one).commands[name]


class LazyGroup(typer.core.TyperGroup):
    """The group of all commands."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.commands = _Commands()
