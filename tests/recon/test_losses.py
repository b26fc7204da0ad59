"""The losses that a map can be fitted with: targets from spikes, gradients, and their use by name."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from spiked.blocks import aligned_window
from spiked.errors import ConfigurationError
from spiked.recon import LossName, MapOptions, Options, Reconstructor
from spiked.recon.frontend.spike_targets import AdjacentSpikes, SpikeCounts, TargetKind, record_target, record_targets
from spiked.recon.frontend.windowing import make_view
from spiked.recon.mapping.loss import BinomialLoss, ViewLoss
from spiked.recon.mapping.pyramid import Target
from spiked.sensor import Image, Intrinsics, Mosaic, Response, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

SENSOR = Sensor(48, 32, 20_000.0, intrinsics=Intrinsics(40.0, 40.0, 24.0, 16.0))


def packed(images: np.ndarray) -> np.ndarray:
    """Images of 0 and 1 [n, H, W] as stored frames of `SENSOR`."""
    rows = images[:, ::-1] if SENSOR.flipped else images
    return np.packbits(rows.reshape(len(images), -1), axis=1, bitorder="little")


def regular(period: np.ndarray, frames: int) -> np.ndarray:
    """Spikes of pixels that fire every `period` [H, W] frames, images [n, H, W]; the first in frame 0."""
    return np.stack([k % period == 0 for k in range(frames)]).astype(np.uint8)


def test_counts_and_intervals_are_those_of_the_spikes() -> None:
    period = np.random.default_rng(0).integers(2, 11, (32, 48))
    images = regular(period, 80)
    frames = packed(images)
    counts = record_target(TargetKind.COUNTS, frames, SENSOR, 100, 132, 148)
    assert isinstance(counts, SpikeCounts) and (counts.begin, counts.end) == (-16, 16)
    np.testing.assert_array_equal(counts.count, images[24:56].sum(0))
    found = record_target(TargetKind.ADJACENT, frames, SENSOR, 100, 132, 148)
    assert isinstance(found, AdjacentSpikes) and found.valid.all()
    np.testing.assert_allclose(found.rate(), 1 / period, rtol=1e-6)
    middle = 0.5 * (found.times()[0] + found.times()[1])
    last = 39 // period * period  # the last spike before frame 40, the middle of the view
    np.testing.assert_allclose(middle, last + 0.5 + 0.5 * period - 40, atol=1e-5)


def test_a_pixel_without_two_spikes_has_half_of_its_bound() -> None:
    images = np.zeros((64, 32, 48), np.uint8)
    images[40, 5, 6] = 1
    found = record_target(TargetKind.ADJACENT, packed(images), SENSOR, 0, 24, 40)
    assert found.rate()[0, 0] == pytest.approx(0.5 / 64) and found.rate()[5, 6] == pytest.approx(1 / 64)


def test_a_view_shows_its_target_only_to_the_map() -> None:
    images = regular(np.full((32, 48), 5), 64)
    images[30] = 1  # one spike too many in each pixel: the count has it
    frames = packed(images)
    window = aligned_window(frames, SENSOR, 0, 24, 40)
    view = make_view(window, SENSOR, after_gap=False, targets=record_targets((*TargetKind,), frames, SENSOR, 0, 24, 40))
    assert view.nbytes > make_view(window, SENSOR, after_gap=False).nbytes
    np.testing.assert_array_equal(view.showing(TargetKind.COUNTS).rate, images[16:48].sum(0) / np.float32(32))
    assert view.showing(TargetKind.ADJACENT).rate[0, 0] == pytest.approx(1 / 5)
    times, windows, seen = view.showing(TargetKind.COUNTS).exposure(4)
    assert seen.all() and times[0] == 16 and times[-1] == 48 and (windows[1] - windows[0] == 4).all()


LOSSES = [MapOptions(loss=name, ssim=ssim, ssim_scale=1.0) for name in LossName for ssim in (0.0, 1.0, 0.2)]


@pytest.mark.parametrize("mosaic", [None, Mosaic.RGGB])
@pytest.mark.parametrize("options", LOSSES, ids=lambda o: f"{o.loss}-{o.ssim}")
def test_the_gradient_is_that_of_finite_differences(options: MapOptions, mosaic: Mosaic | None) -> None:
    rng = np.random.default_rng(1)
    values, image = rng.uniform(0.1, 0.4, (2, 20, 24)).astype(np.float32)
    check(options.view_loss(), image, Target(values, np.full(values.shape, 0.02, np.float32), None), rng, mosaic)


def test_the_gradient_of_colours_at_half_size_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(2)
    values, image = rng.uniform(0.1, 0.4, (2, 10, 12, 3)).astype(np.float32)
    check(BinomialLoss(), image, Target(values, np.full(values.shape, 0.02, np.float32), None, pixel=2), rng, None)


def check(loss: ViewLoss, image: Image, target: Target, rng: np.random.Generator, mosaic: Mosaic | None) -> None:
    """Along one random direction; at the border `luminance` mirrors the image."""
    direction = np.zeros_like(image)
    direction[2:-2, 2:-2] = rng.normal(size=direction[2:-2, 2:-2].shape)
    slope = loss.compare(image, target, 0.4, mosaic).slope
    ahead, behind = (
        loss.compare(image + np.float32(step) * direction, target, 0.4, mosaic).value for step in (1e-3, -1e-3)
    )
    assert np.float64(slope * direction).sum() == pytest.approx((ahead - behind) / 2e-3, rel=0.02)


def test_the_likelihood_is_greatest_at_the_counts_and_ignores_where_in_a_block_they_are() -> None:
    rng = np.random.default_rng(3)
    values = rng.uniform(0.1, 0.4, (16, 24)).astype(np.float32)
    target = Target(values, np.zeros_like(values), None)
    assert BinomialLoss().compare(values, target, 0.4).value == pytest.approx(0, abs=1e-9)
    pooled = values.reshape(4, 4, 6, 4).mean((1, 3)).repeat(4, 0).repeat(4, 1)
    made = BinomialLoss().compare(pooled, target, 0.4)
    assert made.value == pytest.approx(0, abs=1e-9) and np.abs(made.slope).max() < 1e-6
    assert BinomialLoss().compare(values + np.float32(0.05), target, 0.4).value > 0


@pytest.mark.parametrize("name", [name for name in LossName if name is not LossName.CHARGE])
def test_a_map_is_fitted_with_each_loss(name: LossName, fitted: Callable[[LossName], tuple[float, float]]) -> None:
    before, after = fitted(name)
    assert after < 0.95 * before  # most of what is left is the noise of the spikes


@pytest.fixture(scope="module")
def fitted() -> Callable[[LossName], tuple[float, float]]:
    """Fits a map of the simulated room on its true poses; returns the loss of the first and of the last steps."""
    source = SimulatedCamera(Sensor(160, 120, 20_000.0), seed=1, motion=MotionKind.ARC, flow_px=0.3)
    frames = source.next_frames(400)
    rotations, centres = source.truth(np.arange(400))
    truth = Trajectory((np.arange(400) + 0.5) / source.sensor.frame_rate_hz, rotations, centres)

    def fit(name: LossName) -> tuple[float, float]:
        options = Options(steps=100, poses=truth, loss=name)
        made = Reconstructor(replace(source.sensor, intrinsics=source.intrinsics), options)
        made.feed(0, frames)
        losses: list[float] = []
        made.finish(lambda status: losses.append(status.loss or np.inf))
        assert made.failure is None
        return losses[0], losses[-1]

    return fit


def test_losses_of_spike_cameras_are_refused_for_photons() -> None:
    sensor = Sensor(48, 32, 20_000.0, intrinsics=SENSOR.intrinsics, response=Response.BERNOULLI)
    with pytest.raises(ConfigurationError, match="counts photons: use the loss charge"):
        Reconstructor(sensor, Options(loss=LossName.BINOMIAL))
