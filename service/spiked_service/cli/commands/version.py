"""`spiked version`: installed versions."""

import platform

import numpy as np

from spiked.blocks import instruction_sets
from spiked.errors import ConfigurationError
from spiked.render.choice import chosen
from spiked_service.base.version import installed_version
from spiked_service.cli.console import output


def renderer() -> str:
    """The renderer in use and the reason, or why there is none."""
    try:
        return str(chosen())
    except ConfigurationError as error:
        return f"none ({error})"


def version() -> None:
    """Print the versions of spiked, Python and NumPy, the instruction sets and the renderer."""
    output.print(f"spiked {installed_version()}")
    output.print(f"python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}")
    output.print(f"instruction sets: {', '.join(instruction_sets())}")
    output.print(f"renderer: {renderer()}", markup=False)
