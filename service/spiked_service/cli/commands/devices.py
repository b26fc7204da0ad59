"""`spiked devices`: cameras and other sources, and a check of this machine."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from spiked_driver.source_kind import Device
from spiked_driver.source_kinds import KINDS, known_devices
from spiked_driver.usb_cameras import UDEV_FILE, UDEV_RULES

from spiked_service.cli.console import messages, output
from spiked_service.operations.doctor import Diagnosis, DiagnosisStatus, examine
from spiked_service.settings.settings import load_settings
from spiked_service.store.folder import default_folder

_COLOURS = {DiagnosisStatus.OK: "green", DiagnosisStatus.WARNING: "yellow", DiagnosisStatus.PROBLEM: "red"}


def devices(
    doctor: Annotated[
        bool, typer.Option("--doctor", help="Check udev rules, permissions, USB, processor and disk.")
    ] = False,
    udev_rules: Annotated[
        bool, typer.Option("--udev-rules", help="Print the udev rules that let users open cameras.")
    ] = False,
    data: Annotated[Path | None, typer.Option(help="Folder of recordings; --doctor checks its disk.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List cameras and other sources for `spiked serve --device`.

    Examples:

    - `spiked devices --doctor`

    - `spiked devices --udev-rules | sudo tee /etc/udev/rules.d/70-spiked.rules`
    """
    if udev_rules:
        print(UDEV_RULES)
        messages.print(
            f"write these lines to {UDEV_FILE}, then run: sudo udevadm control --reload && sudo udevadm trigger",
            markup=False,
        )
        return
    if doctor:
        findings = examine(data or load_settings().settings.data or default_folder())
        if as_json:
            print(json.dumps([asdict(finding) for finding in findings], indent=2))
        else:
            _show_findings(findings)
        if any(finding.status is DiagnosisStatus.PROBLEM for finding in findings):
            raise typer.Exit(1)
        return
    found = known_devices(load_settings().settings.devices)
    if as_json:
        print(json.dumps([asdict(device) for device in found], indent=2))
    else:
        _show_devices(found)


def _show_devices(found: list[Device]) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("device", "state", "port", "speed", "serial", "firmware", "what it is"):
        table.add_column(heading)
    for device in found:
        about = [device.port, device.speed, device.serial, device.firmware]
        table.add_row(device.source, device.state, *(text or "-" for text in about), device.description)
    output.print(table)
    for one in KINDS:
        output.print(f"{one.usage}: {one.summary}", markup=False)
    for device in found:
        if device.reason:
            output.print(f"{device.source}: {device.reason}", markup=False)
    for kind in sorted({device.kind for device in found if device.capabilities}):
        named = next(device for device in found if device.kind == kind and device.capabilities)
        listed = ", ".join(f"{name} {capability}" for name, capability in named.capabilities.items())
        output.print(f"{kind} cameras: {listed}".replace("_", " "), markup=False)


def _show_findings(findings: list[Diagnosis]) -> None:
    for finding in findings:
        output.print(f"[{_COLOURS[finding.status]}]{finding.status:8s}[/] {finding.name}: ", end="")
        output.print(finding.finding, markup=False)
        if finding.what_to_do:
            output.print(f"         {finding.what_to_do}", markup=False)
