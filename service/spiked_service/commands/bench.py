"""`spiked bench`: the kernels' speed, with ratios that mean something on any machine."""

import json
from pathlib import Path
from typing import Annotated

import typer
from spiked_driver.framing import benchmark_usb
from spiked_driver.pcie import benchmark_pcie

from spiked import blocks
from spiked.render import benchmark as renderer
from spiked.render.benchmark import Row
from spiked.ring import benchmark as ring
from spiked.sensor import Sensor
from spiked_service.benchmarks import files, growth, sustained, tracking
from spiked_service.benchmarks.report import Machine, document, text
from spiked_service.console import output


def bench(
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here, too.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="How long a camera's stream is kept up.")] = 6.0,
    scaling: Annotated[
        bool, typer.Option("--scaling", help="Also time against splats, pixels, threads, frames.")
    ] = False,
    folder: Annotated[Path | None, typer.Option(help="Where recordings are written; default: temporary files.")] = None,
    stream: Annotated[
        Path | None,
        typer.Option(help="Track this, a folder as `spiked simulate` writes it; default: a simulated room."),
    ] = None,
) -> None:
    """Measure reduction of frames, ring, recordings, wire parsers, tracking and the renderer on this machine.

    The last column compares with this machine's own peaks, with plain or usual ways to do the same, and, in brackets,
    with what was aimed at. Times are the best or the median of a few runs; their spread stands beside them.
    """
    machine = Machine.here()
    rows = [*_kernels(), *files.rows(folder), *sustained.rows(seconds, folder)]
    rows += [*tracking.rows(stream), *renderer.measure()]
    if scaling:
        rows += growth.rows()
    for line in text(machine, rows):
        output.print(line, markup=False)
    if json_file is not None:
        json_file.write_text(json.dumps(document(machine, rows), indent=2) + "\n")


BLOCK_TARGETS = {"one block 400x250": "<= 1200 ns", "one block 1000x1000": "<= 12000 ns"}


def _kernels() -> list[Row]:
    rows = [
        Row(
            reduced.name,
            reduced.ns_per_frame,
            "ns/frame",
            reduced.memcpy_ratio,
            "times memcpy's time",
            BLOCK_TARGETS.get(reduced.name.rsplit(" ", 1)[0], "")
            if reduced.name.endswith(blocks.instruction_sets()[0])
            else "",
        )
        for reduced in blocks.benchmark()
    ]
    moved = ring.benchmark(Sensor(400, 250, 20_000.0))
    speed = moved.ring_bytes_a_second
    against = f"of memcpy's speed; {speed / moved.camera_bytes_a_second:.1f} times the camera's rate"
    rows.append(Row("ring 400x250 between two processes", speed * 1e-6, "MB/s", moved.ratio, against, threads=2))
    for name, wire in (("parse the USB3 wire", benchmark_usb()), ("parse the raw PCIe stream", benchmark_pcie())):
        rows.append(Row(name, wire.parsed_bytes_a_second * 1e-6, "MB/s", wire.ratio, "of memcpy's speed"))
    return rows
