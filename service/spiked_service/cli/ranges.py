"""Ranges of frames or seconds in options."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import typer


@dataclass(frozen=True)
class Range:
    """From `begin` to `end`, exclusive, in frames or seconds; None: the begin or end of the recording."""

    begin: float | None
    end: float | None


def number_range(number: Callable[[str], float]) -> Callable[[str], Range]:
    """A parser of options: reads `A:B`; None for what is left out."""

    def parse(text: str) -> Range:
        try:
            begin, end = (number(part) if part.strip() else None for part in text.split(":"))
        except ValueError as error:
            raise typer.BadParameter(f"{text!r} is no range: write A:B, A: or :B") from error
        if any(one is not None and not 0 <= one < math.inf for one in (begin, end)):
            raise typer.BadParameter(
                f"{text!r}: a range counts from the begin of the recording, in finite numbers >= 0"
            )
        return Range(begin, end)

    return parse
