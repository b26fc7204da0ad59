"""Steps on a GPU: sub-images a second, memory, and the share of the time that no kernel runs."""

import time

import numpy as np
import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from spiked.render import Rasteriser
from spiked.render.benchmark import SIZES, Size, passing, scene
from spiked.render.cuda import INSTANTS, CudaRasteriser

STEPS = 50


def measure(size: Size, sub_frames: int) -> None:
    """One line: forward and backward of a moving camera, all sub-images in one batch."""
    camera, splats = scene(size, 3)
    rasteriser = CudaRasteriser(camera)
    rotations, centres = passing(camera, sub_frames + 1)
    windows = np.zeros((2, size.height, size.width), np.float32)
    windows[1] = sub_frames
    d_values = np.ones((size.height, size.width, 3), np.float32)

    def step() -> None:
        rasteriser.forward_moving(splats, rotations, centres, windows)
        rasteriser.backward(d_values)

    step()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    begin = time.perf_counter()
    for _ in range(STEPS):
        step()
    torch.cuda.synchronize()
    seconds = (time.perf_counter() - begin) / STEPS
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        begin = time.perf_counter()
        for _ in range(STEPS):
            step()
        torch.cuda.synchronize()
        wall = time.perf_counter() - begin
    busy = sum(event.device_time for event in profiled.events() if event.device_type == DeviceType.CUDA) * 1e-6
    images = sub_frames * INSTANTS
    cpu = Rasteriser(camera)
    begin = time.perf_counter()
    cpu.forward_moving(splats, rotations, centres, windows)
    cpu.backward(d_values)
    on_cpu = time.perf_counter() - begin
    print(
        f"{size.splats} splats {size.width}x{size.height}, {images} sub-images: {1e3 * seconds:.1f} ms a step, "
        f"{images / seconds:.0f} sub-images/s, {torch.cuda.max_memory_allocated() / 2**20:.0f} MiB, "
        f"{100 * max(0.0, 1 - busy / wall):.0f} % outside kernels, CPU {1e3 * on_cpu:.0f} ms"
    )


if __name__ == "__main__":
    print(torch.cuda.get_device_name(), torch.__version__)
    for benchmark_size in (*SIZES, Size(100_000, 1000, 1000)):
        for parts in (1, 2, 4):
            measure(benchmark_size, parts)
