"""Steps on a GPU beside those of the CPU and, where it is installed, of gsplat: one line for each scene.

A step is forward, backward and Adam for one colour; images and their gradients come and go through main memory in ours,
and stay on the device in gsplat's, which makes no step of Adam.
"""

import time
from collections.abc import Callable

import numpy as np

from spiked.render import Rasteriser, gpu
from spiked.render.benchmark import SIZES, Size, passing, scene
from spiked.render.descent import Descent, DeviceDescent
from spiked.scene import Scene

STEPS = 50
RATES = (1e-9,) * 5


def median_ms(step: Callable[[], object]) -> float:
    """Of `STEPS` calls, after five."""
    times = []
    for _ in range(STEPS + 5):
        begin = time.perf_counter()
        step()
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times[5:]))


def gsplat_ms(size: Size, splats: Scene, focal: float) -> float | None:
    """Forward and backward of gsplat with everything on the device; None where it is not installed."""
    try:
        import gsplat
        import torch
    except ImportError:
        return None
    leaves = [torch.tensor(array, device="cuda", requires_grad=True) for array in splats.arrays()]
    means, quats, log_scales, logits, colour = leaves
    view = torch.eye(4, device="cuda")[None]
    k = torch.tensor([[[focal, 0, size.width / 2], [0, focal, size.height / 2], [0, 0, 1]]], device="cuda")

    def step() -> None:
        values, _, _ = gsplat.rasterization(
            means, quats, log_scales.exp(), logits.sigmoid(), colour, view, k, size.width, size.height, packed=False
        )
        values.sum().backward()
        torch.cuda.synchronize()

    return median_ms(step)


def measure(size: Size, sub_frames: int) -> None:
    """One line; 0 sub-frames: a camera that stands still."""
    camera, splats = scene(size)
    slope = np.full((size.height, size.width), 1e-6, np.float32)
    rotations, centres = passing(camera, sub_frames + 1) if sub_frames else (np.eye(3)[None], np.zeros((1, 3)))
    windows = np.zeros((2, size.height, size.width), np.float32)
    windows[1] = sub_frames
    times = []
    for rasteriser, kind in ((gpu.GpuRasteriser(camera), DeviceDescent), (Rasteriser(camera), Descent)):
        fit = kind(splats.select(np.arange(len(splats))), 0.9, 0.99)

        def step(rasteriser: Rasteriser = rasteriser, fit: Descent = fit) -> None:
            if sub_frames:
                rasteriser.forward_moving(fit.model, rotations, centres, windows)  # type: ignore[arg-type]
            else:
                rasteriser.forward(fit.model, rotations, centres)  # type: ignore[arg-type]
            fit.step(rasteriser, slope, RATES, np.float32(9))

        times.append(median_ms(step))
    theirs = None if sub_frames else gsplat_ms(size, splats, camera.intrinsics.fx)
    print(
        f"{size.splats} splats, {size.width}x{size.height}, {sub_frames} sub-frames: {times[0]:.2f} ms a step, "
        f"CPU {times[1]:.1f} ms" + ("" if theirs is None else f", gsplat {theirs:.2f} ms"),
        flush=True,
    )


if __name__ == "__main__":
    reason = gpu.missing()
    if reason is not None:
        raise SystemExit(reason)
    print(gpu.device_name(), *gpu.ARCHITECTURES)
    for benchmark_size in (*SIZES, Size(80_000, 400, 250), Size(200_000, 1000, 1000)):
        for parts in (0, 2):
            measure(benchmark_size, parts)
