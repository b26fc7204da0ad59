"""The command `spiked`: its parts are in `commands`, its errors are one line and exit code 2."""

import sys

import typer

from spiked.errors import SpikedError
from spiked_service.commands.bench import bench
from spiked_service.commands.calibrate import calibrate
from spiked_service.commands.config import config
from spiked_service.commands.convert import convert
from spiked_service.commands.devices import devices
from spiked_service.commands.evaluate import evaluate
from spiked_service.commands.info import info
from spiked_service.commands.noise_report import noise_report
from spiked_service.commands.openapi import openapi
from spiked_service.commands.reconstruct import reconstruct
from spiked_service.commands.render import render
from spiked_service.commands.serve import serve
from spiked_service.commands.simulate import simulate
from spiked_service.commands.token import token
from spiked_service.commands.verify import verify
from spiked_service.commands.version import version
from spiked_service.console import report_error

app = typer.Typer(
    name="spiked",
    help="Spike-camera recordings in, camera trajectory and Gaussian scene out, live or from files.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
for _group, _commands in {
    "Live": (serve, devices),
    "Files": (info, verify, convert, simulate, calibrate, noise_report),
    "Scenes": (reconstruct, render, evaluate),
    "This program": (bench, openapi, version),
}.items():
    for _command in _commands:
        app.command(rich_help_panel=_group)(_command)
app.add_typer(config, name="config", rich_help_panel="Live")
app.add_typer(token, name="token", rich_help_panel="Live")


def main() -> None:
    """Run `spiked` with the arguments of this process."""
    try:
        app()
    except SpikedError as error:
        report_error(error)
        sys.exit(2)
