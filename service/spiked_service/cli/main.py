"""The program `spiked`: registers the commands, prints errors as one line and exits with code 2."""

import os
import sys
from typing import Annotated

import typer

from spiked.errors import SpikedError
from spiked_service.base.version import installed_version
from spiked_service.cli.commands.backup import backup, restore
from spiked_service.cli.commands.baseline import baseline
from spiked_service.cli.commands.bench import bench
from spiked_service.cli.commands.calibrate import calibrate
from spiked_service.cli.commands.clean import clean
from spiked_service.cli.commands.compare import compare
from spiked_service.cli.commands.config import config
from spiked_service.cli.commands.convert import convert
from spiked_service.cli.commands.cut import cut
from spiked_service.cli.commands.datasets import datasets
from spiked_service.cli.commands.devices import devices
from spiked_service.cli.commands.doctor import doctor
from spiked_service.cli.commands.evaluate import evaluate
from spiked_service.cli.commands.export import export
from spiked_service.cli.commands.health import health
from spiked_service.cli.commands.info import info
from spiked_service.cli.commands.localise import localise
from spiked_service.cli.commands.merge import merge
from spiked_service.cli.commands.noise_report import noise_report
from spiked_service.cli.commands.offset import offset
from spiked_service.cli.commands.openapi import openapi
from spiked_service.cli.commands.reconstruct import reconstruct
from spiked_service.cli.commands.record import record
from spiked_service.cli.commands.render import render
from spiked_service.cli.commands.report import report
from spiked_service.cli.commands.scale import scale
from spiked_service.cli.commands.serve import serve
from spiked_service.cli.commands.simulate import simulate
from spiked_service.cli.commands.token import token
from spiked_service.cli.commands.verify import verify
from spiked_service.cli.commands.version import version
from spiked_service.cli.commands.video import video
from spiked_service.cli.console import output, report_error

app = typer.Typer(
    name="spiked",
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


for _group, _commands in {
    "Live": (serve, record, devices, health, backup, restore),
    "Files": (info, verify, cut, convert, offset, simulate, calibrate, noise_report),
    "Scenes": (reconstruct, localise, merge, scale, clean, render, evaluate, report, export, baseline, compare),
    "This program": (doctor, bench, openapi, version),
}.items():
    for _command in _commands:
        app.command(rich_help_panel=_group)(_command)
app.add_typer(config, name="config", rich_help_panel="Live")
app.add_typer(datasets, name="datasets", rich_help_panel="Scenes")
app.add_typer(video, name="video", rich_help_panel="Scenes")
app.add_typer(token, name="token", rich_help_panel="Live")


def main() -> None:
    """Run `spiked` with the arguments of this process."""
    os.environ["PYTHONSAFEPATH"] = "1"  # child processes must not import modules from the current folder
    try:
        app()
    except SpikedError as error:
        report_error(error)
        sys.exit(2)
