"""Flags that inject faults into sources that are not cameras."""

from collections.abc import Sequence
from typing import Annotated
from urllib.parse import urlencode

import typer
from spiked_driver.source_kinds import KINDS, find_kind

from spiked.errors import ConfigurationError

_KINDS = " and ".join(f"{kind.name}:" for kind in KINDS if kind.takes_faults)
_PANEL = f"Fault injection ({_KINDS})"

Drop = Annotated[
    float | None, typer.Option("--drop", help="Lose this fraction of the frames at random.", rich_help_panel=_PANEL)
]
Gap = Annotated[
    list[str] | None,
    typer.Option(
        "--gap", help="Lose frames, FIRST:LENGTH or FIRST:LENGTH:CAUSE, e.g. 8000:40ms.", rich_help_panel=_PANEL
    ),
]
Corrupt = Annotated[
    float | None,
    typer.Option("--corrupt", help="Add noise to some pixels of this fraction of the frames.", rich_help_panel=_PANEL),
]
UnplugAt = Annotated[
    list[str] | None,
    typer.Option("--unplug-at", help="Disconnect the camera, FRAME:LENGTH, e.g. 5000:2s.", rich_help_panel=_PANEL),
]
Stall = Annotated[
    list[str] | None,
    typer.Option("--stall", help="Deliver nothing for a time, FRAME:SECONDS.", rich_help_panel=_PANEL),
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
    """The sources with the faults added to their options. Raises ConfigurationError without a suitable source."""
    flags = {"drop": drop, "gap": gap, "corrupt": corrupt, "unplug-at": unplug_at, "stall": stall}
    options = urlencode({name: value for name, value in flags.items() if value}, doseq=True, safe=":")
    if not options:
        return list(sources)
    names = ", ".join(f"--{name}" for name, value in flags.items() if value)
    if not sources:
        raise ConfigurationError(f"{names}: give the source with --device, e.g. --device sim:")
    for source in sources:
        kind = find_kind(source)
        if kind is not None and not kind.takes_faults:
            raise ConfigurationError(
                f"{names}: faults can be injected into {_KINDS} only, not into {source}; "
                "leave out the flags or the camera"
            )
    return [f"{source}{'&' if '?' in source else '?'}{options}" for source in sources]
