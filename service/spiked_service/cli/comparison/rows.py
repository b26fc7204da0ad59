"""The rows of a comparison: a method, or a variant of one, is a command of this program with its options.

A new row is a line here or `--row` on the command line; what it needs is an option that anybody can give.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from spiked.errors import ConfigurationError

TRUTH = "{truth}"
"""Stands for the file of true poses beside the recording."""
COMMANDS = "reconstruct", "baseline"
"""Commands that a row may be."""


@dataclass(frozen=True)
class Row:
    """A method in a table."""

    name: str
    arguments: tuple[str, ...]
    """Command and options, without the recording, the folder and the seed."""
    summary: str = ""
    share_of_steps: float = 1.0
    """Of the steps that the comparison is asked for."""

    @property
    def needs_truth(self) -> bool:
        """Whether it starts from the true poses."""
        return TRUTH in self.arguments

    @classmethod
    def parsed(cls, text: str) -> "Row":
        """From `NAME=COMMAND OPTIONS`. Raises ConfigurationError."""
        name, equals, command = text.partition("=")
        try:
            arguments = tuple(shlex.split(command))
        except ValueError as error:
            raise ConfigurationError(f"--row {text!r}: {error}") from error
        if not equals or not _plain(name) or not arguments or arguments[0] not in COMMANDS:
            raise ConfigurationError(
                f"--row {text!r}: write NAME=COMMAND OPTIONS, a name of letters, digits, . _ + and -, and a command of "
                f"{' and '.join(COMMANDS)}, for instance 'small=reconstruct --max-views 100'"
            )
        return cls(name, arguments, "given by --row")


def _row(name: str, command: str, summary: str, share_of_steps: float = 1.0) -> Row:
    return Row(name, tuple(command.split()), summary, share_of_steps)


def _plain(name: str) -> bool:
    return bool(name) and name[0].isalnum() and all(letter.isalnum() or letter in "._+-" for letter in name)


GROUPS: dict[str, tuple[Row, ...]] = {
    "methods": (_row("spiked", "reconstruct", "this program with default options"),),
    "baselines": (
        _row("colmap-tfp", "baseline --images tfp", "COLMAP on means of a window, and a map of them"),
        _row("colmap-tfi", "baseline --images tfi", "COLMAP on intervals between spikes, and a map of them"),
        _row("colmap-charge", "baseline --images charge", "COLMAP on charge between spikes, and a map of it"),
    ),
    "poses-given": (
        _row("given-spiked", f"reconstruct --poses {TRUTH}", "the map of this program on the true path"),
        _row("given-tfp", f"baseline --poses given --given {TRUTH} --images tfp", "a map of means on the true path"),
        _row(
            "given-tfi", f"baseline --poses given --given {TRUTH} --images tfi", "a map of intervals on the true path"
        ),
        _row(
            "given-charge",
            f"baseline --poses given --given {TRUTH} --images charge",
            "a map of charge, camera still during a picture, on the true path",
        ),
    ),
}
"""All rows, by groups that `--methods` names as one."""


def rows() -> dict[str, Row]:
    """All named rows."""
    return {row.name: row for group in GROUPS.values() for row in group}


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> list[Row]:
    """The rows of these names, groups and own definitions, each once. Raises ConfigurationError."""
    known, found = rows(), dict[str, Row]()
    for name in names:
        if name not in known and name not in GROUPS:
            raise ConfigurationError(
                f"--methods {name}: there is no such row; rows are {', '.join(known)}, groups {', '.join(GROUPS)}; "
                "--row makes another"
            )
        found |= {row.name: row for row in GROUPS.get(name, () if name not in known else (known[name],))}
    for text in own:
        row = Row.parsed(text)
        if row.name in found or row.name in known:
            raise ConfigurationError(f"--row {row.name}: a row of that name exists; give it another one")
        found[row.name] = row
    if not found:
        raise ConfigurationError("a comparison needs a method: give --methods or --row")
    return list(found.values())
