"""How time and memory grow with the size of the work, with fitted exponents."""

import subprocess
import sys

import numpy as np

from spiked.blocks import aligned_window
from spiked.measurement import Measurement, repeated
from spiked.render import benchmark as renderer
from spiked.sensor import Sensor

WINDOW_FRAMES = 40
"""Frames of a spike-aligned window."""
_MEMORY = """
import sys
import numpy as np
from spiked.render.benchmark import Size, scene
from spiked.render import Rasteriser
camera, splats = scene(Size(int(sys.argv[1]), 400, 250))
rasteriser = Rasteriser(camera, 1)
rasteriser.forward(splats, np.eye(3)[None], np.zeros((1, 3)))
rasteriser.backward(np.ones((250, 400), np.float32))
# Not getrusage: its figure begins with that of the process that started this one.
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


def rows() -> list[Measurement]:
    """A row for each size, and one for each exponent; bytes a splat."""
    found = []
    for scaling in [*renderer.scaling(), _frames()]:
        for size, seconds in zip(scaling.sizes, scaling.seconds, strict=True):
            threads = int(size) if scaling.name == "threads" else 1
            found.append(Measurement(f"{scaling.name}: {size:,.0f}", seconds * 1e3, "ms", threads=threads))
        found.append(Measurement(f"{scaling.name}: exponent", scaling.exponent, ""))
    small, large = 20_000, 200_000
    found.append(
        Measurement("memory of a step, a splat", (peak_bytes(large) - peak_bytes(small)) / (large - small), "bytes")
    )
    return found


def peak_bytes(splats: int) -> float:
    """Peak memory of a separate process for one step with this many splats."""
    run = subprocess.run([sys.executable, "-c", _MEMORY, str(splats)], capture_output=True, text=True, check=True)
    return 1024 * float(run.stdout)


def _frames() -> renderer.Scaling:
    sensor = Sensor(400, 250, 20_000.0)
    counts = [1_000, 10_000, 100_000]
    chunk = np.random.default_rng(0).integers(0, 256, (1000, sensor.frame_bytes), np.uint8)

    def seconds(frames: int) -> float:
        def work() -> None:
            out = None
            for first in range(0, frames, len(chunk)):
                for begin in range(0, len(chunk), WINDOW_FRAMES):
                    end = min(begin + WINDOW_FRAMES, len(chunk))
                    out = aligned_window(chunk[begin:end], sensor, first, first, first + end - begin, out=out)

        return repeated(work, 3).best_s

    return renderer.Scaling("frames in windows", list(map(float, counts)), [seconds(n) for n in counts])
