"""The table of commands: all there are, each loaded when it is asked for."""

import subprocess
import sys
from pathlib import Path

import spiked_service.cli.commands
import typer
from spiked_service.cli.command_table import PANELS, LazyGroup
from spiked_service.cli.main import app
from typer.main import get_command


def test_every_command_is_in_a_panel_and_is_called_as_its_module() -> None:
    modules = {file.stem for file in Path(spiked_service.cli.commands.__path__[0]).glob("[a-z]*.py")}
    names = [name for panel in PANELS.values() for name in panel]
    assert sorted(names) == sorted(module.replace("_", "-") for module in modules)
    group = get_command(app)
    assert isinstance(group, LazyGroup)
    assert list(group.commands) == names
    with typer.Context(group) as context:
        for name in names:
            listed, loaded = group.get_command(context, name), group.commands[name]
            assert listed.name == loaded.name == name and listed.rich_help_panel == loaded.rich_help_panel
            assert listed.get_short_help_str(999) == loaded.get_short_help_str(999) != ""


def test_a_command_loads_no_other() -> None:
    """The libraries of all of them take seconds."""
    code = "import sys\nfrom spiked_service.cli.main import main\ntry:\n    main()\nfinally:\n    print(*sys.modules)"
    for words, lacks in (("--version", "numpy"), ("--help", "numpy"), ("none", "numpy"), ("verify --help", "fastapi")):
        done = subprocess.run([sys.executable, "-c", code, *words.split()], capture_output=True, text=True, check=False)
        loaded = done.stdout.splitlines()[-1].split()
        assert "typer" in loaded and lacks not in loaded


def test_the_service_loads_no_tracker() -> None:
    """Its workers do: here they would double the time of a start."""
    code = "import sys\nimport spiked_service.cli.commands.serve\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "spiked_service.api.app" in loaded
    assert not loaded & {
        "spiked.recon.odometry.odometry",
        "spiked.recon.reconstructor",
        "scipy.linalg",
        "scipy.spatial",
    }
