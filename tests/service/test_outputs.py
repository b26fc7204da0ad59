"""Every command that writes tries its outputs before it works: the error comes first, and nothing is left behind."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import pytest
import typer
from spiked_service.cli import outputs
from spiked_service.cli.command_table import PANELS
from spiked_service.cli.main import app

from spiked.errors import ConfigurationError

MISSING = "missing"
"""Of an input. That it is not there is noticed later than an output that cannot be written."""
WRITERS: dict[tuple[str, str], list[str]] = {
    ("reconstruct", "--out"): [MISSING],
    ("reconstruct", "--resume"): [],
    ("render", "--out"): [MISSING, "--poses", MISSING],
    ("simulate", "--out"): ["--scene", MISSING, "--poses", MISSING],
    ("calibrate", "--out"): [MISSING],
    ("calibrate", "--write-profile"): [MISSING, "--out", "calibration.npz"],
    ("convert", "OUT"): [MISSING],
    ("cut", "--out"): [MISSING, "--frames", "0:1"],
    ("evaluate", "--json"): [MISSING, "--recording", MISSING],
    ("evaluate", "--pictures"): [MISSING, "--recording", MISSING],
    ("baseline", "--out"): [MISSING],
    ("compare", "--out"): [MISSING],
    ("report", "--out"): [MISSING],
    ("record", "--out"): ["sim:"],
    ("localise", "--out"): [MISSING, MISSING],
    ("localise", "--json"): [MISSING, MISSING],
    ("merge", "--out"): [MISSING, MISSING],
    ("clean", "--out"): [MISSING],
    ("export", "--out"): [MISSING, "ply"],
    ("noise-report", "--json"): [MISSING],
    ("bench", "--json"): ["--stream", MISSING],
    ("bench", "--folder"): ["--stream", MISSING],
    ("openapi", "--out"): [],
    ("backup", "--to"): ["--data", MISSING],
}
FOLDERS = {
    ("reconstruct", "--out"),
    ("reconstruct", "--resume"),
    ("render", "--out"),
    ("simulate", "--out"),
    ("evaluate", "--pictures"),
    ("baseline", "--out"),
    ("compare", "--out"),
    ("record", "--out"),
    ("localise", "--out"),
    ("merge", "--out"),
    ("clean", "--out"),
    ("bench", "--folder"),
}
READS = {
    "file",
    "files",
    "flat",
    "dark",
    "source",
    "scene",
    "poses",
    "first_depth",
    "result",
    "recording",
    "calibration",
    "profile",
    "stream",
    "given",
    "token_file",
    "video",
    "map",
    "map_folder",
    "first",
    "second",
    "evaluation",
}
"""Parameters that are paths to read."""
OF_THE_SERVICE = {"data", "runtime", "config"}


def paths() -> Iterator[tuple[str, str]]:
    """The options of all commands that are paths and not read."""
    for command in (name for names in PANELS.values() for name in names):
        module = command.replace("-", "_")
        function = getattr(import_module(f"spiked_service.cli.commands.{module}"), module)
        if isinstance(function, typer.Typer):
            continue
        for name, kind in get_type_hints(function, include_extras=True).items():
            if "pathlib.Path" in str(kind) and name not in READS | OF_THE_SERVICE:
                (declared,) = (part for part in kind.__metadata__ if hasattr(part, "param_decls"))
                names = [
                    part for part in (declared.default, *(declared.param_decls or ())) if str(part).startswith("--")
                ]
                option = next(iter(names), f"--{name}")
                argument = isinstance(declared, typer.models.ArgumentInfo)
                yield command, name.upper() if argument else option


def told(command: str, *arguments: str) -> str:
    """The error that ends the command."""
    with pytest.raises(ConfigurationError) as error:
        app([command, *arguments], standalone_mode=False)
    return str(error.value)


def test_every_command_that_writes_is_tried_here() -> None:
    found = set(paths())
    assert found == set(WRITERS)


@pytest.mark.parametrize("where", ["below a file", "where nobody can write", "of the other kind"])
@pytest.mark.parametrize(("command", "option"), WRITERS)
def test_an_output_that_cannot_be_written_is_told_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, option: str, where: str
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "file").write_text("mine")
    match where:
        case "below a file":
            place = folder / "file" / "out"
        case "where nobody can write":
            place = Path("/proc/self/out")  # the kernel lets not even root make files here
        case _:
            place = folder / "file" if (command, option) in FOLDERS else folder
    before = sorted(tmp_path.rglob("*"))
    named = [] if option == "OUT" else [option]
    assert told(command, *WRITERS[command, option], *named, str(place)).startswith(f"{option} {place} ")
    assert sorted(tmp_path.rglob("*")) == before
    assert (folder / "file").read_text() == "mine"


def test_a_result_that_cannot_be_written_over_is_told_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "scene.ply").mkdir(parents=True)
    assert "--out out/scene.ply is a folder" in told("reconstruct", MISSING, "-o", "out")


def test_a_disk_that_fills_while_results_are_written_is_told() -> None:
    full = Path("/dev/full")
    with pytest.raises(ConfigurationError, match="No space left on device; name"), outputs.writing("--json", full):
        full.write_text("figures")
