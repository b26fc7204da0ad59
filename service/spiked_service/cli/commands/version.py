"""`spiked version`: installed versions."""

import json
import platform
import sys
from typing import Annotated, Any

import numpy as np
import typer

from spiked.blocks import instruction_sets
from spiked.errors import ConfigurationError
from spiked.render.choice import chosen
from spiked_service.base.version import installed_version
from spiked_service.cli.console import output
from spiked_service.operations.installation import installed_packages
from spiked_service.store.migrations import MIGRATIONS


def renderer() -> str:
    """The renderer in use and the reason, or why there is none."""
    try:
        return str(chosen())
    except ConfigurationError as error:
        return f"none ({error})"


def version(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON, with the versions of all packages that it uses.")
    ] = False,
) -> None:
    """Print the versions of spiked, Python and NumPy, the instruction sets and the renderer.

    Examples:

    - `spiked version`

    - `spiked version --json | jq .catalogue_schema`
    """
    if as_json:
        print(json.dumps(_all(), indent=2))
        return
    output.print(f"spiked {installed_version()}")
    output.print(f"python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}")
    output.print(f"instruction sets: {', '.join(instruction_sets())}")
    output.print(f"renderer: {renderer()}", markup=False)


def _all() -> dict[str, Any]:
    return {
        "spiked": installed_version(),
        "python": platform.python_version(),
        "executable": sys.executable,
        "system": platform.system(),
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()),
        "instruction_sets": list(instruction_sets()),
        "renderer": renderer(),
        "api": "v1",
        "catalogue_schema": len(MIGRATIONS),
        "packages": installed_packages(),
    }
