"""PSNR of a scene against the views of a recording: compares the versions of one reconstruction."""

from collections.abc import Sequence

import numpy as np

from spiked.recon.frontend.windowing import View, grey, luminance
from spiked.recon.statistics import WHITE_PERCENTILE
from spiked.render import AnyRasteriser
from spiked.scene import Scene
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory

COMPARED_VIEWS = 8
"""Number of views compared, spread over the recording."""
NEAREST_FRAMES = 0.51
"""Largest distance of a pose from the time of a view, in frames: half a frame and the rounding of the time."""


def scene_psnr_db(
    chosen: Sequence[View], sensor: Sensor, rasteriser: AnyRasteriser, scene: Scene, trajectory: Trajectory
) -> float:
    """PSNR of a scene rendered along a trajectory, against noisy views, each scaled to the view's brightness.

    A view without a pose counts as rendered black.
    """
    rate = sensor.frame_rate_hz
    rows = trajectory.nearest(np.array([view.time / rate for view in chosen]), NEAREST_FRAMES / rate)
    errors, whites = [], []
    for view, row in zip(chosen, rows, strict=True):
        seen = luminance(view.rate, sensor.mosaic) if view.sharp is None else view.sharp
        shown = np.zeros_like(seen)
        if row >= 0:
            rendered = rasteriser.forward(scene, trajectory.rotations[row, None], trajectory.centres[row, None])
            shown = grey(rendered.values)
        brightness = float((seen * shown).sum()) / max(float((shown * shown).sum()), 1e-12)
        errors.append(float(np.mean((seen - brightness * shown) ** 2)))
        whites.append(float(np.percentile(seen, WHITE_PERCENTILE)))
    return float(-10 * np.log10(max(float(np.mean(errors)), 1e-12) / max(float(np.mean(whites)), 1e-6) ** 2))
