"""How time and memory grow with the size of the work, with fitted exponents."""

import subprocess
import sys

import numpy as np

from spiked.blocks import reduce_blocks
from spiked.render import benchmark as renderer
from spiked.render.benchmark import Row, repeated
from spiked.sensor import Sensor

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


def rows() -> list[Row]:
    """A row for each size, and one for each exponent; bytes a splat and a frame."""
    found = []
    for law in [*renderer.scaling(), _frames()]:
        for size, seconds in zip(law.sizes, law.seconds, strict=True):
            threads = int(size) if law.name == "threads" else 1
            found.append(Row(f"{law.name}: {size:,.0f}", seconds * 1e3, "ms", threads=threads))
        found.append(Row(f"{law.name}: exponent", law.exponent, ""))
    small, large = 20_000, 200_000
    found.append(Row("memory of a step, a splat", (peak_bytes(large) - peak_bytes(small)) / (large - small), "bytes"))
    sensor = Sensor(400, 250, 20_000.0)
    blocks = reduce_blocks(np.zeros((8, sensor.frame_bytes), np.uint8), sensor, 0)
    kept = blocks.count.nbytes + blocks.first.nbytes + blocks.last.nbytes
    found.append(Row("memory of a block of 8 frames, a frame, 400x250", kept / 8, "bytes"))
    return found


def peak_bytes(splats: int) -> float:
    """Most memory that a process of its own takes for a step of so many splats."""
    run = subprocess.run([sys.executable, "-c", _MEMORY, str(splats)], capture_output=True, text=True, check=True)
    return 1024 * float(run.stdout)


def _frames() -> renderer.Scaling:
    sensor = Sensor(400, 250, 20_000.0)
    counts = [1_000, 10_000, 100_000]
    chunk = np.random.default_rng(0).integers(0, 256, (1000, sensor.frame_bytes), np.uint8)
    out = reduce_blocks(chunk, sensor, 0)

    def seconds(frames: int) -> float:
        def work() -> None:
            for first in range(0, frames, len(chunk)):
                reduce_blocks(chunk, sensor, first, out=out)

        return repeated(work, 3).best_s

    return renderer.Scaling("frames reduced", list(map(float, counts)), [seconds(n) for n in counts])
