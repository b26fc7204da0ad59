"""`spiked devices`: what can be captured from on this machine, and whether the machine is fit for it."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from spiked_driver.usb_cameras import UDEV_FILE, UDEV_RULES

from spiked_service.config import load_settings
from spiked_service.console import messages, output
from spiked_service.devices import Device, known_devices
from spiked_service.doctor import Finding, Status, examine
from spiked_service.store.folder import default_folder

_COLOURS = {Status.OK: "green", Status.WARNING: "yellow", Status.PROBLEM: "red"}


def devices(
    doctor: Annotated[
        bool, typer.Option("--doctor", help="Check rules, permissions, USB, processor and disk.")
    ] = False,
    udev_rules: Annotated[
        bool, typer.Option("--udev-rules", help="Print the rules that let users open cameras.")
    ] = False,
    data: Annotated[Path | None, typer.Option(help="Folder of recordings whose disk --doctor looks at.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """List the cameras and sources that `spiked serve --device` can be given.

    Examples:

    - `spiked devices --doctor`

    - `spiked devices --udev-rules | sudo tee /etc/udev/rules.d/70-spiked.rules`
    """
    if udev_rules:
        print(UDEV_RULES)
        messages.print(
            f"put these lines into {UDEV_FILE}, then: sudo udevadm control --reload && sudo udevadm trigger",
            markup=False,
        )
        return
    if doctor:
        findings = examine(data or load_settings().settings.data or default_folder())
        if as_json:
            print(json.dumps([asdict(finding) for finding in findings], indent=2))
        else:
            _show_findings(findings)
        if any(finding.status is Status.PROBLEM for finding in findings):
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
    for device in found:
        if device.reason:
            output.print(f"{device.source}: {device.reason}", markup=False)
    for kind in sorted({device.kind for device in found if device.capabilities}):
        named = next(device for device in found if device.kind == kind and device.capabilities)
        told = ", ".join(f"{name} {capability}" for name, capability in named.capabilities.items())
        output.print(f"{kind} cameras: {told}".replace("_", " "), markup=False)


def _show_findings(findings: list[Finding]) -> None:
    for finding in findings:
        output.print(f"[{_COLOURS[finding.status]}]{finding.status:8s}[/] {finding.name}: ", end="")
        output.print(finding.finding, markup=False)
        if finding.what_to_do:
            output.print(f"         {finding.what_to_do}", markup=False)
