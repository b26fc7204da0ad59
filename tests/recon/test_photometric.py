"""Gains of pixels and levels of views, told apart from the scene."""

import numpy as np

from spiked.recon.mapping.photometric import Nuisances
from spiked.sensor import Image

SHAPE = (40, 60)


def scene(rng: np.random.Generator, views: int) -> list[Image]:
    """The same texture, moved on by a few pixels from view to view."""
    wide = rng.uniform(0.1, 0.4, (SHAPE[0], SHAPE[1] + 4 * views)).astype(np.float32)
    return [np.ascontiguousarray(wide[:, 4 * i : 4 * i + SHAPE[1]]) for i in range(views)]


def estimate(gain: Image, levels: np.ndarray) -> Nuisances:
    rng = np.random.default_rng(0)
    nuisances = Nuisances(*SHAPE)
    views = scene(rng, len(levels))
    deviation = np.full(SHAPE, 0.004, np.float32)
    for _ in range(4):
        for key, (image, level) in enumerate(zip(views, levels, strict=True)):
            noise = rng.normal(0, 0.004, SHAPE)
            nuisances.observe(key, image, (gain * level * image + noise).astype(np.float32), deviation)
        nuisances.update()
    return nuisances


def test_fixed_pattern_and_flicker_are_found_together() -> None:
    rng = np.random.default_rng(1)
    gain = np.exp(0.03 * rng.standard_normal(SHAPE)).astype(np.float32)
    gain /= np.exp(np.log(gain).mean())
    levels = 1 + 0.1 * np.sin(np.arange(40))
    found = estimate(gain, levels)
    assert np.std(found.gain / gain) < 0.6 * np.std(gain)
    relative = np.array([found.level(key) for key in range(40)]) / (levels / levels.mean())
    assert np.std(relative) < 0.005


def test_without_a_pattern_none_is_invented() -> None:
    found = estimate(np.ones(SHAPE, np.float32), np.ones(30))
    assert np.std(found.gain) < 0.01
    assert abs(np.log(found.gain).mean()) < 1e-5
    assert all(abs(found.level(key) - 1) < 0.01 for key in range(30))


def test_a_view_that_was_never_seen_has_the_common_level() -> None:
    assert estimate(np.ones(SHAPE, np.float32), np.full(10, 2.0)).level(99) == 1.0
