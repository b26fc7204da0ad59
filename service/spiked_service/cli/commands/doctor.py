"""`spiked doctor`: a check of this installation."""

from pathlib import Path
from typing import Annotated

import typer

from spiked_service.cli.findings import show_findings
from spiked_service.operations.doctor import examine
from spiked_service.operations.installation import examine_installation
from spiked_service.settings.settings import load_settings
from spiked_service.store.folder import default_folder


def doctor(
    cameras: Annotated[
        bool, typer.Option("--cameras", help="Also check the machine for USB cameras; writes 128 MiB to try the disk.")
    ] = False,
    data: Annotated[Path | None, typer.Option(help="Data folder of the service.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file, instead of the default files.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Check this installation: program, packages, settings, data folder, catalogue, address, TLS, memory, renderer.

    Changes nothing. The exit status is 1 if there is a problem. A service may be running.

    Examples:

    - `spiked doctor`

    - `sudo -u spiked spiked doctor --config /etc/spiked/spiked.toml`

    - `spiked doctor --cameras --json`
    """
    findings = examine_installation(config, data)
    if cameras:
        seen = {finding.name for finding in findings}
        folder = data or load_settings({}, config).settings.data or default_folder()
        findings += [finding for finding in examine(folder) if finding.name not in seen]
    show_findings(findings, as_json)
