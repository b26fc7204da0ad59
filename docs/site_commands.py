"""Reference of the command line: one page for each command, made from the program itself."""

import re
from typing import Any

import typer
from site_markdown import cell, code, page, table
from spiked_service.cli.main import app

FOLDER = "reference/commands"


def commands() -> dict[str, Any]:
    """Every command by what one types, such as `spiked token create`, groups among them; the program itself first."""
    found: dict[str, Any] = {}

    def add(words: str, command: Any) -> None:
        found[words] = command
        for name, one in getattr(command, "commands", {}).items():
            if not one.hidden:
                add(f"{words} {name}", one)

    add("spiked", typer.main.get_command(app))
    return found


def path_of(words: str) -> str:
    """The page of a command, below docs/."""
    return f"{FOLDER}/{words.removeprefix('spiked').strip().replace(' ', '-') or 'index'}.md"


def records(words: str, command: Any) -> dict[str, list[tuple[str, str]]]:
    """Arguments and options of a command as its help names and explains them, by the heading that they are below."""
    context = typer.Context(command, info_name=words)
    found: dict[str, list[tuple[str, str]]] = {}
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is not None:
            plain = "Options" if record[0].startswith("-") else "Arguments"
            found.setdefault(getattr(parameter, "rich_help_panel", None) or plain, []).append(record)
    return found


def command_page(words: str, command: Any) -> str:
    """Markdown of one command: usage, help, arguments, options, and of a group its commands."""
    context = typer.Context(command, info_name=words)
    usage = re.sub(r"[{}]", "", command.get_usage(context).removeprefix("Usage: "))
    tables = []
    for heading, rows in records(words, command).items():
        head = ("argument" if heading == "Arguments" else "option", "meaning")
        tables += [f"## {heading}", table(head, [(code(name), cell(text)) for name, text in rows])]
    inside = [
        (f"[`{words} {name}`]({path_of(f'{words} {name}').rsplit('/', 1)[-1]})", cell(summary(one)))
        for name, one in getattr(command, "commands", {}).items()
    ]
    listed = ["## Commands", table(("command", "what it does"), inside)] if inside else []
    return page(f"# {words}", f"```text\n{' '.join(usage.split())}\n```", help_of(command), *tables, *listed)


def help_of(command: Any) -> str:
    """The help of a command, with its examples as blocks that can be copied."""
    text = command.help or ""
    text = re.sub(r"^- `(.+)`$", r"```\n\1\n```", text, flags=re.MULTILINE)
    return re.sub(r"^Example: `(.+)`$", r"Example:\n\n```\n\1\n```", text, flags=re.MULTILINE)


def summary(command: Any) -> str:
    """The first paragraph of the help of a command."""
    return str(command.help or "").split("\n\n")[0]


def index_page(found: dict[str, Any]) -> str:
    """Markdown of the program: its options, and the commands by group."""
    top = found["spiked"]
    groups: dict[str, list[tuple[str, ...]]] = {}
    for name, command in top.commands.items():
        link = f"[`spiked {name}`]({path_of(f'spiked {name}').rsplit('/', 1)[-1]})"
        groups.setdefault(str(command.rich_help_panel), []).append((link, cell(summary(command))))
    tables = [
        part for group, rows in groups.items() for part in (f"## {group}", table(("command", "what it does"), rows))
    ]
    options = [(code(name), cell(text)) for rows in records("spiked", top).values() for name, text in rows]
    return page(
        "# Command line",
        top.help,
        "Each command prints this help with `--help`. Errors are one sentence, and the exit status is then 2.",
        *tables,
        "## Options before the command",
        table(("option", "meaning"), options),
    )


def pages() -> dict[str, str]:
    """Every page of this reference: path below docs/ and Markdown."""
    found = commands()
    made = {path_of(words): command_page(words, command) for words, command in found.items() if words != "spiked"}
    return {path_of("spiked"): index_page(found), **made}
