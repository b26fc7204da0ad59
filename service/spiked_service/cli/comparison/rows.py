"""The rows of a comparison: a method, or a variant of one, is a command of this program with its options.

A new row is a line here or `--row` on the command line; what it needs is an option that anybody can give.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from spiked.errors import ConfigurationError
from spiked.recon import METHODS, MethodName

TRUTH = "{truth}"
"""Stands for the file of true poses beside the recording."""
FROM_TRACKS = "reconstruct --method nope-sgs --initialisation tracks"
"""The method of the paper, made to converge (docs/paper.md)."""
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


def _given(name: str, options: str, summary: str) -> Row:
    """A variant of the map on the true path, which the row `given-spiked` is the measure of."""
    named = " ".join(f"--map-option {option}" for option in options.split())
    return _row(name, f"reconstruct --poses {TRUTH} {named}", summary)


def _theirs(name: str, options: str, summary: str) -> Row:
    """A variant of the method of the paper from a tracked path, which the row `nope-sgs-tracked` is the measure of."""
    return _row(f"nope-sgs-{name}", f"{FROM_TRACKS} {options}", summary)


def _plain(name: str) -> bool:
    return bool(name) and name[0].isalnum() and all(letter.isalnum() or letter in "._+-" for letter in name)


GROUPS: dict[str, tuple[Row, ...]] = {
    "methods": (
        _row("spiked", "reconstruct", "this program with default options"),
        _row("nope-sgs", "reconstruct --method nope-sgs", METHODS[MethodName.NOPE_SGS].summary),
        _row("nope-sgs-tracked", FROM_TRACKS, "the same from a tracked path, with which it converges"),
    ),
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
    "losses": tuple(
        _row(f"loss-{loss}", f"reconstruct --poses {TRUTH} --loss {loss}", f"{what}, on the true path")
        for loss, what in (
            ("charge", "charge between spikes, the default"),
            ("accumulation", "spikes counted in 32 frames"),
            ("interval", "interval between two spikes"),
            ("binomial", "likelihood of the spikes of 16 pixels and 32 frames"),
            ("accumulation+binomial", "accumulation and likelihood, as the paper fits its scene"),
        )
    ),
    "paper-ablation": (
        _theirs("no-accumulation", "--loss binomial", "without the accumulation loss: likelihood alone"),
        _theirs("no-likelihood", "--loss accumulation", "accumulation loss alone"),
        _theirs("interval", "--loss interval", "interval loss instead"),
        _theirs("photometric-poses", "--pose-step alignment", "poses by our photometric alignment, not its gradient"),
        *(
            _theirs(f"sub-frames-{n}", f"--map-option sub_frames={n}", f"{n} sub-frames instead of 4")
            for n in (1, 2, 8)
        ),
        _theirs(
            "demosaic-first", "--map-option demosaic_first=true", "of a mosaic: colours interpolated before the fit"
        ),
    ),
    "ablation": (
        _given("still", "sub_frames=0", "camera taken as still during a view"),
        *(_given(f"sub-frames-{n}", f"sub_frames={n}", f"{n} sub-frames, blur matched") for n in (1, 2, 4)),
        *(
            _given(f"sharp-sub-frames-{n}", f"sub_frames={n} blur_matched=false", f"{n} sub-frames, each without blur")
            for n in (2, 4)
        ),
        _given("no-nuisances", "nuisances=false", "gains of pixels and brightness of views not estimated"),
        _given("black-background", "background=0", "black background while fitting"),
        _given("doubtful-depth", "seeding.sure=0", "first splats of doubtful depth as well"),
        _given("no-ssim", "ssim=0", "without structural similarity"),
        _given("full-size", "schedule.coarse_share=1e-9", "full size from the start"),
        _given("no-detail", "detail=0", "fine detail of fast motion not raised"),
        _row(
            "demosaic-last",
            f"reconstruct --poses {TRUTH} --window-frames 8",
            "of a mosaic: windows of 8 frames, its sites",
        ),
        _row(
            "demosaic-first",
            f"reconstruct --poses {TRUTH} --window-frames 8 --map-option demosaic_first=true",
            "the same with colours interpolated before the fit",
        ),
        _row("path-tracked", "reconstruct --steps 0", "the path before the map corrects it"),
        _row("path-kept", "reconstruct --no-refine-poses", "a map that does not correct the path"),
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
