"""Trouble to rehearse, as flags of the commands that take sources: the fault options of `replay:` and `sim:`."""

from collections.abc import Sequence
from typing import Annotated
from urllib.parse import urlencode

import typer
from spiked_driver.spec import is_camera

from spiked.errors import ConfigurationError

_PANEL = "Rehearse trouble (replay: and sim:)"

Drop = Annotated[
    float | None, typer.Option("--drop", help="Fraction of the frames lost at random.", rich_help_panel=_PANEL)
]
Gap = Annotated[
    list[str] | None,
    typer.Option(
        "--gap", help="FIRST:LENGTH or FIRST:LENGTH:CAUSE: frames to lose, as 8000:40ms.", rich_help_panel=_PANEL
    ),
]
Corrupt = Annotated[
    float | None,
    typer.Option("--corrupt", help="Fraction of the frames with noise in some pixels.", rich_help_panel=_PANEL),
]
UnplugAt = Annotated[
    list[str] | None,
    typer.Option(
        "--unplug-at", help="FRAME:LENGTH: the camera is away for so long, as 5000:2s.", rich_help_panel=_PANEL
    ),
]
Stall = Annotated[
    list[str] | None,
    typer.Option("--stall", help="FRAME:SECONDS: nothing comes for a while.", rich_help_panel=_PANEL),
]


def with_faults(
    sources: Sequence[str],
    *,
    drop: float | None = None,
    gap: Sequence[str] | None = None,
    corrupt: float | None = None,
    unplug_at: Sequence[str] | None = None,
    stall: Sequence[str] | None = None,
) -> list[str]:
    """The sources with the faults among their options. Raises ConfigurationError without a source for them."""
    flags = {"drop": drop, "gap": gap, "corrupt": corrupt, "unplug-at": unplug_at, "stall": stall}
    options = urlencode({name: value for name, value in flags.items() if value}, doseq=True, safe=":")
    if not options:
        return list(sources)
    names = ", ".join(f"--{name}" for name, value in flags.items() if value)
    if not sources:
        raise ConfigurationError(f"{names}: name the source that shall have trouble, as --device sim:")
    if cameras := [source for source in sources if is_camera(source)]:
        raise ConfigurationError(
            f"{names}: trouble is rehearsed with replay: and sim:, not with a real camera ({cameras[0]}); leave one out"
        )
    return [f"{source}{'&' if '?' in source else '?'}{options}" for source in sources]
