"""`spiked bench`: the kernels' speed, with ratios that mean something on any machine."""

from spiked_driver.framing import benchmark_usb
from spiked_driver.pcie import benchmark_pcie

from spiked import blocks
from spiked.render import benchmark as renderer
from spiked.ring import benchmark as ring
from spiked.sensor import Sensor
from spiked_service.console import output


def bench() -> None:
    """Measure the reduction of frames, the ring, the wire parsers and the renderer on this machine.

    The last column compares: with copying the same bytes, with the camera's rate, with the processor's peak.
    """
    for reduced in blocks.benchmark():
        _row(reduced.name, reduced.ns_per_frame, "ns/frame", f"{reduced.memcpy_ratio:.1f} times memcpy's time")
    moved = ring.benchmark(Sensor(400, 250, 20_000.0))
    speed = moved.ring_bytes_a_second
    _row("ring 400x250 between two processes", speed * 1e-6, "MB/s", f"{moved.ratio:.2f} of memcpy's speed")
    _row("", speed * 1e-6, "MB/s", f"{speed / moved.camera_bytes_a_second:.1f} times the camera's rate")
    for name, wire in (("parse the USB3 wire", benchmark_usb()), ("parse the raw PCIe stream", benchmark_pcie())):
        _row(name, wire.parsed_bytes_a_second * 1e-6, "MB/s", f"{wire.ratio:.2f} of memcpy's speed")
    for row in renderer.measure():
        _row(row.name, row.value, row.unit, "" if row.ratio is None else f"{row.ratio:.2f} {row.against}")


def _row(name: str, value: float, unit: str, comparison: str) -> None:
    output.print(f"{name:52s} {value:10.2f} {unit:9s} {comparison}", markup=False)
