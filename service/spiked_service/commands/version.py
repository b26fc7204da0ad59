"""`spiked version`: what is installed."""

import platform
from importlib import metadata

import numpy as np

from spiked.blocks import instruction_sets
from spiked_service.console import output


def installed_version() -> str:
    """The version of the installed distribution, or `unknown` when spiked runs from an uninstalled tree."""
    try:
        return metadata.version("spiked")
    except metadata.PackageNotFoundError:
        return "unknown"


def version() -> None:
    """Print the versions of spiked and of what its results depend on."""
    output.print(f"spiked {installed_version()}")
    output.print(f"python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}")
    output.print(f"instruction sets: {', '.join(instruction_sets())}")
