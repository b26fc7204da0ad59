"""Steps on a GPU beside those of the CPU and, where it is installed, of gsplat: one line for each scene.

A step is forward, backward and Adam for one colour; images and their gradients come and go through main memory in ours,
and stay on the device in gsplat's, which makes no step of Adam. The second figure of ours is a step that compares the
image with a view on the device, as maps are fitted to rates: nothing but poses and sums travels.
"""

from spiked.measurement import repeated
from spiked.render import gpu
from spiked.render.benchmark import SIZES, Size, scene, step_on_a_view, steps_with_adam

STEPS = 50


def gsplat_ms(size: Size) -> float | None:
    """Forward and backward of gsplat with everything on the device; None where it is not installed."""
    try:
        import gsplat
        import torch
    except ImportError:
        return None
    camera, splats = scene(size)
    focal = camera.intrinsics.fx
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

    return 1e3 * repeated(step, STEPS).median_s


def measure(size: Size, sub_frames: int) -> None:
    """One line; 0 sub-frames: a camera that stands still."""
    times = [1e3 * timing.median_s for _, timing in steps_with_adam(size, STEPS, sub_frames)]
    compared = 1e3 * step_on_a_view(size, STEPS, sub_frames).median_s
    theirs = None if sub_frames else gsplat_ms(size)
    print(
        f"{size.splats} splats, {size.width}x{size.height}, {sub_frames} sub-frames: {times[0]:.2f} ms a step, "
        f"with its loss {compared:.2f} ms, CPU {times[1]:.1f} ms"
        + ("" if theirs is None else f", gsplat {theirs:.2f} ms"),
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
