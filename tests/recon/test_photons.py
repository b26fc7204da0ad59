"""Single-photon cameras: pixels that fire without memory, from the simulator to a path and a map."""

from pathlib import Path

import numpy as np
import pytest

from spiked.blocks import aligned_window
from spiked.evaluate import score_trajectory
from spiked.recon import Options, Reconstructor
from spiked.recon.frontend.feature_tracks import smoothed
from spiked.recon.frontend.photon_counts import PhotonCounts
from spiked.recon.frontend.windowing import PHOTON_WINDOWS, Windows
from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Intrinsics, Response, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.motion import MotionKind
from spiked.simulate.sensor import SensorNoise, SpikeSensor
from spiked.trajectory import Trajectory

SENSOR = Sensor(160, 96, 97_000.0, intrinsics=Intrinsics.from_fov(160, 96, 60), response=Response.BERNOULLI)


def exposed(flux: np.ndarray, frames: int, seed: int = 0) -> np.ndarray:
    """Stored frames of a still image [96, 160]."""
    camera = SpikeSensor(SENSOR, seed, SensorNoise.none())
    image = np.ascontiguousarray(flux, np.float32)
    return camera.expose(image, image, np.zeros(frames, np.float32))


def test_pixels_fire_without_memory() -> None:
    frames = exposed(np.full((96, 160), 0.357), 400)
    fired = np.unpackbits(frames, axis=1, bitorder="little").astype(float)
    share = 1 - np.exp(-0.357)
    assert abs(fired.mean() - share) < 5 * np.sqrt(share * (1 - share) / fired.size)
    together = (fired[1:] * fired[:-1]).mean()
    assert abs(together - share**2) < 1e-3  # an integrating pixel hardly ever fires twice in a row
    assert not np.array_equal(frames, exposed(np.full((96, 160), 0.357), 400, seed=1))


@pytest.mark.parametrize("flux", [0.03, 0.36, 1.5])
def test_counts_tell_the_flux_and_its_noise(flux: float) -> None:
    frames = exposed(np.full((96, 160), flux), 64)
    counts = PhotonCounts.of(aligned_window(frames, SENSOR, 0, 0, 64))
    rate, deviation = counts.rate(), counts.deviation()
    assert abs(float(rate.mean()) - flux) < 5 * float(rate.std()) / np.sqrt(rate.size) + 0.002
    assert 0.9 < float(np.sqrt((deviation**2).mean()) / rate.std()) < 1.15
    assert counts.times()[0].min() == -32 and counts.times()[1].max() == 32
    out = np.empty(rate.shape, np.float32)
    assert counts.picture(out) is out
    np.testing.assert_array_equal(out, rate)


def test_pixels_that_always_fire_have_a_finite_flux() -> None:
    window = aligned_window(np.full((64, SENSOR.frame_bytes), 255, np.uint8), SENSOR, 0, 0, 64)
    assert 4 < float(PhotonCounts.of(window).rate().max()) < 6


def test_views_are_long_where_photons_are_few() -> None:
    lengths = []
    for flux in (0.02, 2.0):
        (view, *_) = [*Windows(SENSOR, None).feed(0, exposed(np.full((96, 160), flux), 400))]
        assert isinstance(view.intervals, PhotonCounts)
        lengths.append(view.end - view.begin)
    assert lengths[0] == PHOTON_WINDOWS[-1] and lengths[1] <= PHOTON_WINDOWS[1]


def test_pictures_are_blurred_as_their_noise_asks() -> None:
    rng = np.random.default_rng(0)
    clean = np.ones((96, 160), np.float32)
    noisy = np.asarray(clean + 0.1 * rng.standard_normal(clean.shape), np.float32)
    assert smoothed(noisy, 0.1).std() < 0.035 < smoothed(noisy, 0.001).std()


def test_the_response_is_kept_by_a_sidecar(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(exposed(np.full((96, 160), 0.3), 8))
    assert open_recording(path).sensor == SENSOR
    stated = open_recording(path, response=Response.INTEGRATE_AND_FIRE)
    assert stated.sensor.response is Response.INTEGRATE_AND_FIRE and "response" in stated.warnings[0]


def test_a_path_and_a_map_of_photons() -> None:
    """An arc at p = 0.3: the same path read as of a spike camera has far noisier rates."""
    camera = SimulatedCamera(SENSOR, 2, MotionKind.ARC, flow_px=0.02, parallax=0.3, gain=0.8)
    made = Reconstructor(SENSOR, Options(steps=40))
    for first in range(0, 4800, 200):
        made.feed(first, camera.next_frames(200))
    made.finish()
    times = np.arange(4800)
    truth = Trajectory((times + 0.5) / SENSOR.frame_rate_hz, *camera.truth(times))
    score = score_trajectory(truth=truth, estimate=made.trajectory(), frame_rate_hz=SENSOR.frame_rate_hz)
    assert score.coverage > 0.95 and score.errors is not None
    assert score.errors.ate_percent < 3
    assert made.trainer.options.ssim == 0 and len(made.scene()) > 1000
