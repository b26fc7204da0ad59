"""`spiked bench`: speed of the kernels, as ratios that compare between machines."""

import json
from pathlib import Path
from typing import Annotated

import typer
from spiked_driver.framing import benchmark_usb
from spiked_driver.pcie import benchmark_pcie

from spiked import blocks
from spiked.measurement import Measurement
from spiked.render import benchmark as renderer
from spiked.ring import benchmark as ring
from spiked.sensor import Sensor
from spiked_service.cli import outputs
from spiked_service.cli.bench import files, growth, sustained, tracking
from spiked_service.cli.bench.report import Machine, document, text
from spiked_service.cli.console import output


def bench(
    json_file: Annotated[Path | None, typer.Option("--json", help="Also write the figures to this file.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of the sustained stream, in seconds.")] = 6.0,
    scaling: Annotated[
        bool, typer.Option("--scaling", help="Also measure how time grows with splats, pixels, threads and frames.")
    ] = False,
    folder: Annotated[Path | None, typer.Option(help="Folder for recordings. Default: temporary files.")] = None,
    stream: Annotated[
        Path | None,
        typer.Option(help="Folder written by `spiked simulate`, to track. Default: a simulated room."),
    ] = None,
) -> None:
    """Measure spike-aligned windows, ring, recordings, wire parsers, tracking and the renderer on this machine.

    The last column is a ratio to the peak of this machine or to a plain implementation; the target is in brackets.
    Times are the best or the median of a few runs, with their spread.
    """
    if json_file is not None:
        outputs.try_file("--json", json_file)
    if folder is not None:
        outputs.try_folder("--folder", folder)
    machine = Machine.here()
    rows = [*_kernels(), *files.rows(folder), *sustained.rows(seconds, folder)]
    rows += [*tracking.rows(stream), *renderer.measure()]
    if scaling:
        rows += growth.rows()
    for line in text(machine, rows):
        output.print(line, markup=False)
    if json_file is not None:
        with outputs.writing("--json", json_file):
            json_file.write_text(json.dumps(document(machine, rows), indent=2) + "\n")


def _kernels() -> list[Measurement]:
    rows = [
        Measurement(window.name, window.ns_per_frame, "ns/frame", window.memcpy_ratio, "times memcpy's time")
        for window in blocks.benchmark()
    ]
    moved = ring.benchmark(Sensor(400, 250, 20_000.0))
    speed = moved.ring_bytes_a_second
    against = f"of memcpy's speed; {speed / moved.camera_bytes_a_second:.1f} times the camera's rate"
    rows.append(
        Measurement("ring 400x250 between two processes", speed * 1e-6, "MB/s", moved.ratio, against, threads=2)
    )
    for name, wire in (("parse the USB3 wire", benchmark_usb()), ("parse the raw PCIe stream", benchmark_pcie())):
        rows.append(Measurement(name, wire.parsed_bytes_a_second * 1e-6, "MB/s", wire.ratio, "of memcpy's speed"))
    return rows
