"""How fast the renderer is on this machine, next to figures that mean something on any other.

Times are minima over repetitions, for machines that do other work as well.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.native._raster import multiply_adds
from spiked.render.camera import Camera
from spiked.render.cpu import Rasteriser, usable_cores
from spiked.render.loss import dssim, robust
from spiked.render.optimiser import Adam
from spiked.render.splats import Floats, Splats
from spiked.sensor import Intrinsics

OPERATIONS_PER_PIXEL = 18 + 36
"""Vector arithmetic instructions that a splat costs a pixel, forward and backward, for one colour."""


@dataclass(frozen=True)
class Row:
    """One measurement."""

    name: str
    value: float
    unit: str
    ratio: float | None = None
    """A number that can be compared between machines; `against` says what the value was divided by."""
    against: str = ""


@dataclass(frozen=True)
class Size:
    """A benchmark scene."""

    splats: int
    width: int
    height: int


SIZES = (Size(20_000, 400, 250), Size(50_000, 1000, 1000))


def measure(sizes: tuple[Size, ...] = SIZES, repetitions: int = 10) -> list[Row]:
    """All rows: peak, steps of each size on one thread and on all cores, losses and Adam."""
    peak = _peak_per_second()
    rows = [Row("fused multiply-adds, one core", peak * 1e-9, "10^9/s")]
    for size in sizes:
        rows += _steps(size, repetitions, peak)
    rows.append(_against_naive(repetitions))
    rows += _fused(sizes[0], repetitions)
    return rows


def scene(size: Size, colours: int = 1, seed: int = 0) -> tuple[Camera, Splats]:
    """A view filled evenly with splats of random shapes, about 60 of which contribute to a pixel."""
    rng = np.random.default_rng(seed)
    n, width, height = size.splats, size.width, size.height
    focal = 0.9 * width
    z = rng.uniform(1, 6, n)
    x = (rng.uniform(-0.02, 1.02, n) - 0.5) * width / focal * z
    y = (rng.uniform(-0.02, 1.02, n) - 0.5) * height / focal * z
    # 28.5 and 2.2 were found by counting contributions, for these distributions of shape and opacity.
    radius_px = np.sqrt(28.5 * width * height / n / np.pi) / 2.2
    log_scales = np.log(radius_px * z / focal)[:, None] + rng.normal(0, 0.5, (n, 3))
    return Camera(Intrinsics(focal, focal, width / 2, height / 2), width, height), Splats(
        np.stack([x, y, z], 1).astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        log_scales.astype(np.float32),
        rng.normal(-1.5, 1, n).astype(np.float32),
        rng.uniform(0, 1, (n, colours)).astype(np.float32),
    )


def fastest_seconds(work: Callable[[], object], repetitions: int) -> float:
    """The shortest of a few runs."""
    best = np.inf
    for _ in range(repetitions):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return float(best)


def _peak_per_second() -> float:
    done = 0.0

    def work() -> None:
        nonlocal done
        done = multiply_adds(1_000_000)

    seconds = fastest_seconds(work, 5)
    return done / seconds


def _steps(size: Size, repetitions: int, peak: float) -> list[Row]:
    camera, splats = scene(size)
    rotation, centre = np.eye(3)[None], np.zeros((1, 3))
    d_values = np.random.default_rng(1).normal(size=(size.height, size.width)).astype(np.float32)
    rows = []
    for threads in sorted({1, min(2, usable_cores()), usable_cores()}):
        rasteriser = Rasteriser(camera, threads)

        def step(rasteriser: Rasteriser = rasteriser) -> None:
            rasteriser.forward(splats, rotation, centre)
            rasteriser.backward(d_values)

        seconds = fastest_seconds(step, repetitions)
        ideal = rasteriser.block_evaluations * 16 * OPERATIONS_PER_PIXEL / peak / threads
        name = f"step, {size.splats // 1000}k splats, {size.width}x{size.height}, {threads} thread(s)"
        rows.append(Row(f"{name}, {rasteriser.instructions}", seconds * 1e3, "ms", ideal / seconds, "of peak"))
    return rows


def _against_naive(repetitions: int) -> Row:
    size = Size(400, 160, 100)
    camera, splats = scene(size)
    rasteriser = Rasteriser(camera, 1)
    rotation, centre = np.eye(3)[None], np.zeros((1, 3))
    fast = fastest_seconds(lambda: rasteriser.forward(splats, rotation, centre), repetitions)
    slow = fastest_seconds(lambda: naive_image(camera, splats), 1)
    return Row("forward, 400 splats, 160x100, 1 thread", fast * 1e3, "ms", slow / fast, "times as fast as NumPy")


def naive_image(camera: Camera, splats: Splats) -> NDArray[np.float64]:
    """The image [H, W] of one-coloured splats from the origin: each splat at every pixel, in NumPy."""
    k = camera.intrinsics
    columns, rows = np.arange(camera.width) + 0.5, (np.arange(camera.height) + 0.5)[:, None]
    image = np.zeros((camera.height, camera.width))
    through = np.ones_like(image)
    for n in np.argsort(splats.means[:, 2], kind="stable"):
        x, y, z = splats.means[n].astype(np.float64)
        w, a, b, c = splats.quats[n] / np.linalg.norm(splats.quats[n])
        turn = np.array(
            [
                [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
                [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
                [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
            ]
        )
        slope_x = np.clip(x / z, -0.65 * camera.width / k.fx, 0.65 * camera.width / k.fx)
        slope_y = np.clip(y / z, -0.65 * camera.height / k.fy, 0.65 * camera.height / k.fy)
        jacobian = np.array([[k.fx / z, 0, -k.fx * slope_x / z], [0, k.fy / z, -k.fy * slope_y / z]])
        half = jacobian @ turn * np.exp(splats.log_scales[n])
        conic = np.linalg.inv(half @ half.T + 0.3 * np.eye(2))
        dx, dy = columns - (k.fx * x / z + k.cx), rows - (k.fy * y / z + k.cy)
        power = -0.5 * (conic[0, 0] * dx * dx + conic[1, 1] * dy * dy) - conic[0, 1] * dx * dy
        alpha = np.exp(power) / (1 + np.exp(-splats.opacity_logits[n]))
        alpha = np.where(alpha < 1 / 255, 0, np.minimum(alpha, 0.99))
        image += through * alpha * splats.colours[n, 0]
        through *= 1 - alpha
    return image


def _fused(size: Size, repetitions: int) -> list[Row]:
    rng = np.random.default_rng(2)
    shape = (size.height, size.width)
    rendered, target = rng.uniform(size=(2, *shape)).astype(np.float32)
    weight = np.ones(shape, np.float32)
    arrays: list[Floats] = [
        rng.normal(size=rest).astype(np.float32)
        for rest in ((size.splats, 3), (size.splats, 4), (size.splats, 3), (size.splats,), (size.splats, 1))
    ]
    adam = Adam(arrays)
    where = f"{size.width}x{size.height}"
    timed: tuple[tuple[str, Callable[[], object]], ...] = (
        (f"robust loss, {where}", lambda: robust(rendered, target, weight, 0.1)),
        (f"D-SSIM, {where}", lambda: dssim(rendered, target)),
        (f"Adam, {size.splats // 1000}k splats", lambda: adam.step(arrays, arrays, [1e-6] * 5)),
    )
    return [Row(name, fastest_seconds(work, repetitions) * 1e3, "ms") for name, work in timed]
