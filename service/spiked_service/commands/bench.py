"""`spiked bench`: the kernels' speed as ratios that mean something on any machine."""

from spiked import blocks
from spiked.ring.benchmark import benchmark as benchmark_ring
from spiked.sensor import Sensor
from spiked_service.console import output


def bench() -> None:
    """Measure the reduction of frames and the ring on this machine, against copying the same bytes."""
    output.print(f"{'what':52s} {'measured':>16s}  {'ratio':>6s}")
    for row in blocks.benchmark():
        output.print(f"{row.name:52s} {row.ns_per_frame:10.0f} ns/frame  {row.memcpy_ratio:5.1f}x memcpy's time")
    ring = benchmark_ring(Sensor(400, 250, 20_000.0))
    speed = f"{ring.ring_bytes_a_second / 1e6:10.0f} MB/s"
    output.print(f"{'ring 400x250, between two processes':52s} {speed}    {ring.ratio:5.2f}x memcpy's speed")
    spare = ring.ring_bytes_a_second / ring.camera_bytes_a_second
    output.print(f"{'ring 400x250, against the camera':52s} {'':15s}  {spare:6.1f}x the camera's rate")
