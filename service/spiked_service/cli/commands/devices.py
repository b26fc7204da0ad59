"""`spiked devices`: cameras and other sources, and a check of this machine."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from spiked_driver import bridge_probe
from spiked_driver.source_kind import Device, SourceSpec
from spiked_driver.source_kinds import KINDS, known_devices
from spiked_driver.usb_cameras import UDEV_FILE, UDEV_RULES, CameraChoice
from spiked_driver.usb_kind import KIND as USB

from spiked.errors import SourceError
from spiked_service.base.version import installed_version
from spiked_service.cli.console import messages, output
from spiked_service.cli.findings import show_findings
from spiked_service.operations.doctor import examine
from spiked_service.settings.settings import load_settings
from spiked_service.store.folder import default_folder


def devices(
    doctor: Annotated[
        bool, typer.Option("--doctor", help="Check udev rules, permissions, USB, processor and disk.")
    ] = False,
    udev_rules: Annotated[
        bool, typer.Option("--udev-rules", help="Print the udev rules that let users open cameras.")
    ] = False,
    probe: Annotated[
        str | None,
        typer.Option(
            metavar="USB0",
            help="Read a USB camera in each way that its bridge may want, for two seconds each, and say which works.",
        ),
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of recordings; --doctor checks its disk.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List cameras and other sources for `spiked serve --device`.

    Examples:

    - `spiked devices --doctor`

    - `spiked devices --probe usb0`

    - `spiked devices --udev-rules | sudo tee /etc/udev/rules.d/70-spiked.rules`
    """
    if udev_rules:
        print(UDEV_RULES)
        messages.print(
            f"write these lines to {UDEV_FILE}, then run: sudo udevadm control --reload && sudo udevadm trigger",
            markup=False,
        )
        return
    if probe is not None:
        _probe(probe, as_json)
        return
    if doctor:
        show_findings(examine(data or load_settings().settings.data or default_folder()), as_json)
        return
    found = known_devices(load_settings().settings.devices)
    if as_json:
        print(json.dumps([asdict(device) for device in found], indent=2))
    else:
        _show_devices(found)


def _probe(source: str, as_json: bool) -> None:
    spec = SourceSpec.parse(source)
    if not spec.address.startswith(USB.name) or spec.query:
        raise SourceError(f"{source} cannot be probed: name a USB camera without options, as in `usb0` or `usb:2-1.4`")
    report = bridge_probe.probe(CameraChoice.parse(spec.address), lambda name: messages.print(f"trying {name} ..."))
    if as_json:
        ways = [asdict(way) | {"verdict": way.verdict} for way in report.ways]
        print(json.dumps(asdict(report) | {"version": installed_version(), "ways": ways}, indent=2))
    else:
        _show_probe(report)
    if report.works is None:
        raise typer.Exit(1)


def _show_probe(report: bridge_probe.BridgeReport) -> None:
    camera = report.camera
    about = (camera.chip, f"serial {camera.serial}", camera.speed, f"firmware {camera.firmware}")
    output.print(f"camera at {camera.port}: {', '.join(about)}", markup=False)
    output.print(f"bridge: {report.bridge or 'does not tell its configuration'}", markup=False)
    output.print(f"host: {report.host}, spiked {installed_version()}", markup=False)
    for way in report.ways:
        rate = f"{way.frames:,} frames ({way.frames / way.seconds:,.0f} a second), {way.lost:,} lost"
        came = rate if way.frames else "bytes, but no frame" if way.bytes else "nothing"
        line = f"{way.name:22s} {came}; {way.bytes / 1e6:.1f} MB in {way.seconds:.1f} s"
        if way.verdict == "stopped":
            line += f"; nothing after {way.last_byte_s:.1f} s"
        output.print(line + (f"; {way.error}" if way.error else ""), markup=False)
        if way.bytes and not way.frames:
            output.print(f"{'':22s} first bytes: {way.first_bytes}", markup=False)
    works = report.works
    if works is None:
        output.print(
            "no way brought a frame: check cable and power, then send this report to the project", markup=False
        )
    elif works is report.ways[0]:
        output.print("the default works", markup=False)
    else:
        output.print(f"use it so: spiked serve --device 'usb:{camera.port}?{works.options}'", markup=False)


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
