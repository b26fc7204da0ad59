"""The commands of `spiked` by name.

A command's module is imported when it is run: all of them take seconds. Lists of commands, for help and completion,
read what a command says of itself from the source of its module.
"""

import ast
from collections import UserDict
from importlib import import_module
from pathlib import Path
from typing import Any

import typer
import typer.core

from spiked_service.base.signals import holding

PANELS = {
    "Live": ("serve", "record", "devices", "submit", "jobs", "health", "backup", "restore", "config", "token"),
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


def _module(name: str) -> tuple[str, str]:
    """Names of the module of a command, and of the function or group in it."""
    attribute = name.replace("-", "_")
    return f"spiked_service.cli.commands.{attribute}", attribute


def _panel(name: str) -> str:
    return next(panel for panel, names in PANELS.items() if name in names)


def _loaded(name: str) -> Any:
    module, attribute = _module(name)
    with holding():  # packages in compiled code make an ImportError of Ctrl-C
        found = getattr(import_module(module), attribute)
    one = typer.Typer(rich_markup_mode="markdown", pretty_exceptions_enable=False)
    if isinstance(found, typer.Typer):
        one.add_typer(found, name=name, rich_help_panel=_panel(name))
    else:
        one.command(name, rich_help_panel=_panel(name))(found)
    return typer.main.get_group(one).commands[name]


def _listed(name: str) -> typer.core.TyperCommand:
    """A command with nothing but its help."""
    attribute = _module(name)[1]
    text: str | None = None
    for node in ast.parse((Path(__file__).with_name("commands") / f"{attribute}.py").read_bytes()).body:
        match node:
            case ast.FunctionDef(name=function) if function == attribute:
                text = ast.get_docstring(node)
            case ast.Assign(targets=[ast.Name(id=group)], value=ast.Call(keywords=keywords)) if group == attribute:
                text = next(ast.literal_eval(word.value) for word in keywords if word.arg == "help")
    return typer.core.TyperCommand(name, help=text, rich_help_panel=_panel(name))


class LazyGroup(typer.core.TyperGroup):
    """The group of all commands."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.commands = _Commands()

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of all commands."""
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """For lists of commands; None if there is none."""
        return _listed(cmd_name) if cmd_name in self.commands else None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is to be run, or completed."""
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else self.commands[name], rest
