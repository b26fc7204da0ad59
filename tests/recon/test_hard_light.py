"""Days on which the light or the pixels are not as one would like: the path stands, or the state says why not."""

import numpy as np
import pytest

from spiked.evaluate import score_trajectory
from spiked.recon import Options, Reconstructor, State
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import Lighting, MotionKind, PixelMaps, SensorNoise, SimulatedCamera
from spiked.simulate.sensor import GainStep
from spiked.trajectory import Trajectory

FRAMES = 480
SENSOR = Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 60))


def camera(**more: object) -> SimulatedCamera:
    return SimulatedCamera(SENSOR, 2, MotionKind.ARC, flow_px=0.3, parallax=0.5, **more)  # type: ignore[arg-type]


def reconstruct(seen: SimulatedCamera, steps: int = 60) -> tuple[Reconstructor, float, float]:
    """The reconstruction with the error of its path in percent, and its coverage."""
    reconstructor = Reconstructor(SENSOR, Options(steps=steps))
    frames = seen.next_frames(FRAMES)
    for first in range(0, FRAMES, 40):
        reconstructor.feed(first, frames[first : first + 40])
    reconstructor.finish()
    k = np.arange(FRAMES)
    truth = Trajectory((k + 0.5) / SENSOR.frame_rate_hz, *seen.truth(k))
    score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=SENSOR.frame_rate_hz)
    scene = reconstructor.scene()
    assert all(np.isfinite(array).all() for array in scene.arrays())
    return reconstructor, np.inf if score.errors is None else score.errors.ate_percent, score.coverage


def followed(reconstructor: Reconstructor) -> None:
    """The camera is followed; poses that are less certain than usual are said to be, with the reason."""
    status = reconstructor.status()
    assert status.state is State.TRACK or (status.state is State.DEGRADED and status.reason), status


@pytest.fixture(scope="module")
def ordinary() -> float:
    """The path's error in percent on a good day."""
    _, error, coverage = reconstruct(camera())
    assert coverage > 0.98
    return error


def test_dim_light(ordinary: float) -> None:
    """0.05 spikes a frame: one spike in twenty frames."""
    seen = camera(gain=0.11)
    reconstructor, error, coverage = reconstruct(seen)
    followed(reconstructor)
    assert coverage > 0.9 and error < 5 * ordinary + 2.0


def test_fixed_pattern_of_three_percent(ordinary: float) -> None:
    gain = np.exp(0.03 * np.random.default_rng(5).standard_normal((160, 240))).astype(np.float32)
    maps = PixelMaps(gain, np.full((160, 240), 0.002, np.float32))
    reconstructor, error, coverage = reconstruct(camera(maps=maps))
    assert reconstructor.status().state is State.TRACK
    assert coverage > 0.98 and error < 2 * ordinary + 0.5


def test_flicker_of_the_mains(ordinary: float) -> None:
    reconstructor, error, coverage = reconstruct(camera(lighting=Lighting(flicker=0.08, flicker_hz=100)))
    followed(reconstructor)
    assert coverage > 0.98 and error < 2 * ordinary + 0.5


def test_a_lamp_switched_on_in_the_middle(ordinary: float) -> None:
    lamp = Lighting(steps=(GainStep(FRAMES // 2, 1.6),))
    reconstructor, error, coverage = reconstruct(camera(lighting=lamp), steps=600)
    assert reconstructor.status().state is State.TRACK
    assert coverage > 0.98 and error < 2 * ordinary + 0.5
    levels = np.array([reconstructor.level(second) for second in (0.2 * FRAMES / 20000, 0.8 * FRAMES / 20000)])
    assert levels[1] / levels[0] == pytest.approx(1.6, rel=0.05)


def test_windows_that_saturate_and_corners_that_never_fire(ordinary: float) -> None:
    """Bright pixels fire in every frame, and the lens leaves the corners black."""
    x, y = np.meshgrid(np.linspace(-1, 1, 240), np.linspace(-1, 1, 160))
    vignette = (np.hypot(x, y) < 1.15).astype(np.float32)
    maps = PixelMaps(vignette, np.zeros((160, 240), np.float32))
    seen = camera(maps=maps, gain=1.5)
    reconstructor, error, coverage = reconstruct(seen)
    assert reconstructor.status().state is State.TRACK, reconstructor.status()
    assert coverage > 0.95 and error < 3 * ordinary + 1.0


def test_dead_and_hot_pixels(ordinary: float) -> None:
    reconstructor, error, coverage = reconstruct(camera(noise=SensorNoise(hot_share=0.002, dead_share=0.002)))
    assert reconstructor.status().state is State.TRACK
    assert coverage > 0.98 and error < 2 * ordinary + 0.5
