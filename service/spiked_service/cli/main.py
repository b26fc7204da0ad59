"""The program `spiked`: runs commands, prints errors as one line and exits with code 2."""

import errno
import os
import sys
from typing import Annotated

import typer

from spiked.errors import SpikedError
from spiked_service.base.signals import cleaning_up
from spiked_service.base.version import installed_version
from spiked_service.cli.command_table import LazyGroup
from spiked_service.cli.console import output, report_error

app = typer.Typer(
    name="spiked",
    cls=LazyGroup,
    help="Record spike cameras, and reconstruct camera trajectory and Gaussian splats, live or from files.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        output.print(f"spiked {installed_version()}", markup=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options before the command."""


def main() -> None:
    """Run `spiked` with the arguments of this process."""
    os.environ["PYTHONSAFEPATH"] = "1"  # child processes must not import modules from the current folder
    try:
        with cleaning_up():
            app()
    except SpikedError as error:
        report_error(error)
        sys.exit(2)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        report_error(SpikedError(f"{error.filename or 'the output'} cannot be written: the disk is full"))
        sys.exit(2)
