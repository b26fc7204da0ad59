"""Recordings of hard days: what may pass in front of the simulated camera, and how the path is judged."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.evaluate import score_trajectory
from spiked.recon import Options, Reconstructor
from spiked.sensor import Image, Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.spans import PathRadiance
from spiked.trajectory import Trajectory

SENSOR = Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 60))


class ObstructedCamera(SimulatedCamera):
    """A camera with something in front of the scene that moves by itself, in image coordinates."""

    over: Callable[[float, Image], Image] | None = None
    speed_px: float = 0.0
    """How fast it moves, px a frame."""

    def path_radiance(self) -> PathRadiance:
        """With what is in front of the scene."""
        return ObstructedRadiance(self.scene, self.motion, self.sensor, self.intrinsics, self.gain, self)


@dataclass(frozen=True)
class ObstructedRadiance(PathRadiance):
    """The radiance that an obstructed camera sees."""

    camera: ObstructedCamera

    def at_with_depth(self, frame: float) -> tuple[Image, Image]:
        """See `PathRadiance`."""
        seen, depth = super().at_with_depth(frame)
        over = self.camera.over
        return seen if over is None else np.ascontiguousarray(over(frame, seen), np.float32), depth

    def steps_px(self, times: NDArray[np.float64], depth: float) -> NDArray[np.float64]:
        """See `PathRadiance`."""
        return np.maximum(super().steps_px(times, depth), self.camera.speed_px * np.diff(times))


def behind(camera: ObstructedCamera, over: Callable[[float, Image], Image], speed_px: float) -> ObstructedCamera:
    """The camera with something in front of it from its first frame on."""
    camera.over, camera.speed_px = over, speed_px
    return camera


def patch(
    share: float, at: tuple[float, float], velocity: tuple[float, float], seed: int = 5
) -> Callable[[float, Image], Image]:
    """A textured square over a share of the image, its corner `at` px at frame 0, with a velocity in px a frame."""
    height, width = SENSOR.height, SENSOR.width
    side = int(np.sqrt(share * width * height))
    rng = np.random.default_rng(seed)
    layers = [
        cell
        * cv2.resize(rng.random((side // cell,) * 2).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)
        for cell in (3, 6, 12, 24)
    ]
    texture = np.asarray(sum(layers), np.float32)
    texture = 0.35 * (0.05 + 0.9 * (texture - texture.min()) / np.ptp(texture))

    def over(frame: float, seen: Image) -> Image:
        moved = np.array([[1, 0, at[0] + velocity[0] * frame], [0, 1, at[1] + velocity[1] * frame]])
        mask = cv2.warpAffine(np.ones((side, side), np.float32), moved, (width, height))
        return np.asarray(seen * (1 - mask) + cv2.warpAffine(texture, moved, (width, height)), np.float32)

    return over


def wall(begin: float, frames: float, ramp: float = 60) -> Callable[[float, Image], Image]:
    """A blank wall whose edge passes through the image in `ramp` frames from `begin` on, and leaves `frames` later."""
    x = np.arange(SENSOR.width) + 0.5

    def over(frame: float, seen: Image) -> Image:
        first, last = (np.clip((frame - t) / ramp, 0, 1) * SENSOR.width for t in (begin + frames, begin))
        mask = (np.clip(last - x + 0.5, 0, 1) * np.clip(x - first + 0.5, 0, 1)).astype(np.float32)
        return np.asarray(seen * (1 - mask) + 0.175 * mask, np.float32)

    return over


def followed(
    camera: SimulatedCamera, count: int, lost: tuple[int, int] | None = None
) -> tuple[Reconstructor, float, float]:
    """The path without a map, its error in percent and its coverage; frames of `lost` are missing."""
    frames = camera.next_frames(count)
    reconstructor = Reconstructor(SENSOR, Options(steps=0))
    for first, stop in [(0, count)] if lost is None else [(0, lost[0]), (lost[1], count)]:
        if first:
            assert lost is not None
            reconstructor.gap(lost[0], lost[1] - lost[0])
        for at in range(first, stop, 40):
            reconstructor.feed(at, frames[at : min(at + 40, stop)])
    reconstructor.finish()
    path = reconstructor.trajectory()
    assert np.isfinite(path.rotations).all() and np.isfinite(path.centres).all()
    k = np.arange(count)
    truth = Trajectory((k + 0.5) / SENSOR.frame_rate_hz, *camera.truth(k))
    score = score_trajectory(truth=truth, estimate=path, frame_rate_hz=SENSOR.frame_rate_hz)
    return reconstructor, np.inf if score.errors is None else score.errors.ate_percent, score.coverage
