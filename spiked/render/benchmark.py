"""How fast the renderer is on this machine, next to figures that mean something on any other.

Times are minima over repetitions, for machines that do other work as well; the spread says how far they differed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from spiked.measurement import Measurement, Timing, peak_per_second, repeated
from spiked.pose import exp_so3
from spiked.render.camera import Camera
from spiked.render.charge import WARP_CELL_PX, ChargeLoss
from spiked.render.choice import chosen
from spiked.render.comparison import RateTerms
from spiked.render.cpu import Rasteriser, usable_cores
from spiked.render.descent import Descent, DeviceDescent
from spiked.render.gpu import GpuRasteriser
from spiked.render.loss import StructuralSimilarity
from spiked.render.optimiser import Adam
from spiked.render.splats import Floats, MeanAxes, SizeLimits
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor

FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 18, 34
"""Vector arithmetic instructions that a splat costs a pixel, for one colour."""
BETAS = 0.9, 0.99
"""Adam's decay rates."""
MOTION_PX = 2.0
"""Image motion of the moving camera."""
CHARGE_FRAMES = 24
"""Frames that a render is compared with in the step by the charge."""


@dataclass(frozen=True)
class Size:
    """A benchmark scene."""

    splats: int
    width: int
    height: int


SIZES = (Size(20_000, 400, 250), Size(50_000, 1000, 1000))


def measure(sizes: tuple[Size, ...] = SIZES, repetitions: int = 10) -> list[Measurement]:
    """All rows: peak, steps of each size on one thread and on all cores, losses and Adam."""
    peak = peak_per_second()
    rows = [Measurement("multiply-adds of a float32 matrix product, one core", peak * 1e-9, "10^9/s")]
    for size in sizes:
        rows += _steps(size, repetitions, peak)
        if chosen().renderer == "cuda":
            rows.append(on_device(size, repetitions))
    rows += _accumulation(sizes[0], repetitions)
    rows.append(_by_charge(sizes[0], repetitions))
    rows.append(_against_naive(repetitions))
    rows += _fused(sizes[0], repetitions)
    return rows


def scene(size: Size, colours: int = 1, seed: int = 0) -> tuple[Camera, Scene]:
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
    return Camera(Intrinsics(focal, focal, width / 2, height / 2), width, height), Scene(
        np.stack([x, y, z], 1).astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        log_scales.astype(np.float32),
        rng.normal(-1.5, 1, n).astype(np.float32),
        rng.uniform(0, 1, (n, colours)).astype(np.float32),
    )


TARGETS = {
    (20_000, 1): "<= 10 ms",
    (20_000, 2): "<= 5.5 ms",
    (50_000, 1): "<= 80 ms",
    (50_000, 2): "<= 45 ms",
}


def _steps(size: Size, repetitions: int, peak: float) -> list[Measurement]:
    camera, splats = scene(size)
    rotation, centre = np.eye(3)[None], np.zeros((1, 3))
    d_values = np.random.default_rng(1).normal(size=(size.height, size.width)).astype(np.float32)
    rows = []
    for threads in sorted({1, min(2, usable_cores()), usable_cores()}):
        rasteriser = Rasteriser(camera, threads)

        def forward(rasteriser: Rasteriser = rasteriser) -> None:
            rasteriser.forward(splats, rotation, centre)

        def step(rasteriser: Rasteriser = rasteriser) -> None:
            rasteriser.forward(splats, rotation, centre)
            rasteriser.backward(d_values)

        for name, work, operations, target in (
            ("forward", forward, FORWARD_OPERATIONS, ""),
            ("step", step, FORWARD_OPERATIONS + BACKWARD_OPERATIONS, TARGETS.get((size.splats, threads), "")),
        ):
            timing = repeated(work, repetitions)
            share = rasteriser.block_evaluations * 16 * operations / peak / threads / timing.best_s
            label = f"{name}, {size.splats // 1000}k splats, {size.width}x{size.height}, {rasteriser.instructions}"
            rows.append(Measurement(label, timing.best_s * 1e3, "ms", share, "of peak", target, timing.spread, threads))
    return rows


def on_device(size: Size, repetitions: int, device: Literal["cuda", "emulated"] = "cuda") -> Measurement:
    """`steps_with_adam` as a row."""
    (instructions, gpu), (_, cpu) = steps_with_adam(size, repetitions, device=device)
    name = f"step with Adam, {size.splats // 1000}k splats, {size.width}x{size.height}, {instructions}"
    return Measurement(name, gpu.best_s * 1e3, "ms", gpu.best_s / cpu.best_s, "of all cores' step", "", gpu.spread)


def steps_with_adam(
    size: Size, repetitions: int, sub_frames: int = 0, device: Literal["cuda", "emulated"] = "cuda"
) -> list[tuple[str, Timing]]:
    """Steps with Adam, splats on a GPU, image and gradient in main memory, and those of all cores, by what does them.

    0 sub-frames: the camera stands still.
    """
    camera, splats = scene(size)
    poses = passing(camera, sub_frames + 1)
    slope = np.full((size.height, size.width), 1e-6, np.float32)
    windows = np.zeros((2, *slope.shape), np.float32)
    windows[1] = sub_frames
    fits: tuple[tuple[Rasteriser, Descent], ...] = (
        (GpuRasteriser(camera, device=device), DeviceDescent(splats, *BETAS)),
        (Rasteriser(camera), Descent(splats.select(np.arange(len(splats))), *BETAS)),
    )

    def timed(rasteriser: Rasteriser, fit: Descent) -> Timing:
        def step() -> None:
            if sub_frames:
                rasteriser.forward_moving(fit.model, *poses, windows)
            else:
                rasteriser.forward(fit.model, *poses)
            fit.step(rasteriser, slope, (1e-9,) * 5, SizeLimits(), MeanAxes())

        return repeated(step, repetitions)

    return [(rasteriser.instructions, timed(rasteriser, fit)) for rasteriser, fit in fits]


def step_on_a_view(
    size: Size, repetitions: int, sub_frames: int = 0, device: Literal["cuda", "emulated"] = "cuda"
) -> Timing:
    """Steps on a GPU that render, compare with a view and descend: splats, view, image and gradient stay there."""
    camera, splats = scene(size)
    poses = passing(camera, sub_frames + 1)
    rasteriser, fit = GpuRasteriser(camera, device=device), DeviceDescent(splats, *BETAS)
    rates, windows = np.full((size.height, size.width), 0.5, np.float32), None
    if sub_frames:
        windows = np.stack([np.zeros_like(rates), np.full_like(rates, sub_frames)])
    view = rasteriser.frame(rates, np.full_like(rates, 0.05), windows)

    def step() -> None:
        rasteriser.compare(fit.on_device(rasteriser), *poses, view, RateTerms(1.0, 0.03, 0.2, 0.01))
        fit.step(rasteriser, None, (1e-9,) * 5, SizeLimits(), MeanAxes())

    return repeated(step, repetitions)


def passing(
    camera: Camera, poses: int, motion_px: float = MOTION_PX
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations [poses, 3, 3] and centres of a camera that turns and shifts so that the image moves so far."""
    times = np.linspace(-0.5, 0.5, poses)
    angle = motion_px / camera.intrinsics.fx
    return (
        np.stack([exp_so3(np.array([-0.5, 0.8, 0.2]) * angle * t) for t in times]),
        np.outer(times, [0.3, 0.2, 0.1]) * angle,
    )


def _accumulation(size: Size, repetitions: int) -> list[Measurement]:
    """A camera that moves two pixels while it looks, each pixel over its own window, beside one still render."""
    camera, splats = scene(size)
    rng = np.random.default_rng(1)
    shape = (size.height, size.width)
    d_values = rng.normal(size=shape).astype(np.float32)
    windows = np.stack([rng.uniform(0, 0.2, shape), rng.uniform(0.8, 1, shape)]).astype(np.float32)
    rasteriser = Rasteriser(camera, 1)

    def exactly(poses: int) -> Floats:
        """The mean over each pixel's window of so many exact renders."""
        edges = (np.arange(poses + 1, dtype=np.float32) / poses)[:, None, None]
        overlap = np.clip(np.minimum(windows[1], edges[1:]) - np.maximum(windows[0], edges[:-1]), 0, None)
        rotations, centres = passing(camera, 2 * poses + 1)
        weights = (overlap / (windows[1] - windows[0])).astype(np.float32)
        return rasteriser.forward(splats, rotations[1::2], centres[1::2], weights=weights).values

    def step(render: Callable[[], object]) -> Timing:
        def work() -> None:
            render()
            rasteriser.backward(d_values)

        return repeated(work, repetitions)

    truth = exactly(32)
    still = step(lambda: rasteriser.forward(splats, *passing(camera, 1)))
    where = f"{size.splats // 1000}k splats, {size.width}x{size.height}, {MOTION_PX:g} px"
    rows = []
    for sub_frames in (1, 2, 4):
        rotations, centres = passing(camera, sub_frames + 1)
        scaled = windows * np.float32(sub_frames)
        image = rasteriser.forward_moving(splats, rotations, centres, scaled).values
        timing = step(
            lambda rotations=rotations, centres=centres, scaled=scaled: rasteriser.forward_moving(  # type: ignore[misc]
                splats, rotations, centres, scaled
            )
        )
        error = 100 * float(np.std(image - truth) / np.std(truth))
        against = f"of a still step; error {error:.2g} % of contrast"
        target = "<= 3" if sub_frames <= 2 else ""
        name = f"moving step, {sub_frames} sub-frame(s), {where}"
        rows.append(
            Measurement(name, timing.best_s * 1e3, "ms", timing.best_s / still.best_s, against, target, timing.spread)
        )
    timing = step(lambda: exactly(8))
    error = 100 * float(np.std(exactly(8) - truth) / np.std(truth))
    against = f"of a still step; error {error:.2g} % of contrast"
    name = f"8 exact sub-poses, {where}"
    rows.append(Measurement(name, timing.best_s * 1e3, "ms", timing.best_s / still.best_s, against, "", timing.spread))
    return rows


def _by_charge(size: Size, repetitions: int) -> Measurement:
    """A step on all spikes of some frames: one render, carried along its motion, beside that render alone."""
    camera, splats = scene(size)
    width = size.width // 8 * 8
    sensor = Sensor(width, size.height, 20_000.0)
    frames = np.random.default_rng(1).integers(0, 256, (CHARGE_FRAMES, sensor.frame_bytes), np.uint8)
    frames &= np.random.default_rng(2).integers(0, 256, frames.shape, np.uint8)  # a quarter of the pixels fire
    rows, columns = -(-size.height // WARP_CELL_PX) + 1, -(-width // WARP_CELL_PX) + 1
    moved = np.zeros((CHARGE_FRAMES, rows, columns, 2), np.float32)
    moved[...] = (np.arange(CHARGE_FRAMES, dtype=np.float32) - CHARGE_FRAMES / 2)[:, None, None, None]
    gain = np.ones((size.height, width), np.float32)
    rasteriser, charge = Rasteriser(camera, 1), ChargeLoss(sensor, 1)
    pose = np.eye(3)[None], np.zeros((1, 3))

    def still() -> None:
        rasteriser.backward(rasteriser.forward(splats, *pose).values)

    def step() -> None:
        image = rasteriser.forward(splats, *pose).values
        rasteriser.backward(charge(image, frames, moved, gain, floor=0.01).slope)

    one, all_frames = repeated(still, repetitions), repeated(step, repetitions)
    name = f"step by the charge of {CHARGE_FRAMES} frames, {size.splats // 1000}k splats, {size.width}x{size.height}"
    share = all_frames.best_s / one.best_s
    return Measurement(name, all_frames.best_s * 1e3, "ms", share, "of a still step", "<= 3", all_frames.spread)


@dataclass(frozen=True)
class Scaling:
    """Times of steps of growing size, and the exponent of the power law through them."""

    name: str
    sizes: list[float]
    seconds: list[float]

    @property
    def exponent(self) -> float:
        """Slope of log time over log size, by least squares."""
        return float(np.polyfit(np.log(self.sizes), np.log(self.seconds), 1)[0])


def scaling(repetitions: int = 3) -> list[Scaling]:
    """Time of a step against splats and pixels at the same contributions a pixel, against splats of one size, and
    against threads."""

    def seconds(size: Size, threads: int = 1, coverage: int | None = None) -> float:
        """`coverage`: the number of splats that the splats' size is made for."""
        camera, splats = scene(size)
        if coverage is not None:
            splats.log_scales += np.float32(0.5 * np.log(size.splats / coverage))
        d_values = np.ones((size.height, size.width), np.float32)
        rasteriser = Rasteriser(camera, threads)

        def step() -> None:
            rasteriser.forward(splats, np.eye(3)[None], np.zeros((1, 3)))
            rasteriser.backward(d_values)

        return repeated(step, repetitions).best_s

    counts = [5_000, 20_000, 50_000, 200_000, 500_000]
    sides = [(400, 250), (640, 400), (1000, 1000)]
    threads = [n for n in (1, 2, 4, 8, 16) if n <= usable_cores()]
    small = Size(20_000, 400, 250)
    return [
        Scaling("splats, 60 a pixel", list(map(float, counts)), [seconds(Size(n, 400, 250)) for n in counts]),
        Scaling(
            "splats of one size",
            list(map(float, counts[:3])),
            [seconds(Size(n, 400, 250), coverage=20_000) for n in counts[:3]],
        ),
        Scaling(
            "pixels, 60 splats each",
            [float(w * h) for w, h in sides],
            [seconds(Size(50_000, w, h)) for w, h in sides],
        ),
        *([Scaling("threads", list(map(float, threads)), [seconds(small, n) for n in threads])] if threads[1:] else []),
    ]


def _against_naive(repetitions: int) -> Measurement:
    size = Size(400, 160, 100)
    camera, splats = scene(size)
    rasteriser = Rasteriser(camera, 1)
    rotation, centre = np.eye(3)[None], np.zeros((1, 3))
    fast = repeated(lambda: rasteriser.forward(splats, rotation, centre), repetitions).best_s
    slow = repeated(lambda: naive_image(camera, splats), 1).best_s
    return Measurement(
        "forward, 400 splats, 160x100, 1 thread", fast * 1e3, "ms", slow / fast, "times as fast as NumPy"
    )


def naive_image(camera: Camera, splats: Scene) -> NDArray[np.float64]:
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


def _fused(size: Size, repetitions: int) -> list[Measurement]:
    rng = np.random.default_rng(2)
    shape = (size.height, size.width)
    rendered, target = rng.uniform(size=(2, *shape)).astype(np.float32)
    arrays: list[Floats] = [
        rng.normal(size=rest).astype(np.float32)
        for rest in ((size.splats, 3), (size.splats, 4), (size.splats, 3), (size.splats,), (size.splats, 1))
    ]
    adam, similarity = Adam(arrays), StructuralSimilarity()
    where = f"{size.width}x{size.height}"
    timed: tuple[tuple[str, Callable[[], object]], ...] = (
        (f"D-SSIM, {where}", lambda: similarity(rendered, target)),
        (f"Adam, {size.splats // 1000}k splats", lambda: adam.step(arrays, arrays, [1e-6] * 5)),
    )
    return [Measurement(name, repeated(work, repetitions).best_s * 1e3, "ms") for name, work in timed]
