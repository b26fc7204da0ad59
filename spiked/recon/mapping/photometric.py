"""Photometric nuisances: each pixel's gain, and the brightness of each view (flicker, lamps)."""

from typing import Protocol

import numpy as np

from spiked.native._dense import agreement, gain_evidence
from spiked.sensor import Image

GAIN_SIGMA = 0.02
"""Prior deviation of a pixel's gain from 1."""
MODEL_ERROR = 0.07
"""Relative error of the map's render, added to the noise of each residual."""
RESIDUAL_DECAY = 0.7
"""Decay of the accumulated residuals at each update: older ones are of an older map."""
AGREEING_SIGMAS = 3
"""Deviations within which a pixel agrees with the map, and counts for the brightness of its view."""
GAIN_LIMITS = (0.5, 2.0)
"""Limits of a pixel's gain."""


class Evidence(Protocol):
    """Where residuals are added up, as on a GPU: squares of the model, and products with the residual, [H, W]."""

    def set_evidence(self, xx: Image, xy: Image) -> None:
        """The sums to begin with."""

    def evidence(self) -> tuple[Image, Image]:
        """The sums."""


class Nuisances:
    """Estimates gain(x) and a level for each view in `observed = gain(x) * level * rendered`.

    Closed-form weighted regressions; the gains have a ridge towards 1 and mean log gain 0. The levels are relative to
    each other: their mean belongs to the brightness of the scene.
    """

    _elsewhere: Evidence | None = None
    """Where the evidence of the gains is; None: here."""

    def __init__(self, height: int, width: int, fixed: Image | None = None) -> None:
        """`fixed` [H, W] are gains of a calibration; they are not estimated."""
        self.gain: Image = np.ones((height, width), np.float32) if fixed is None else fixed.astype(np.float32)
        self._fixed = fixed is not None
        self._xx = np.zeros((height, width), np.float32)
        self._xy = np.zeros((height, width), np.float32)
        self._observed = 0.0
        self._levels: dict[int, float] = {}
        self._mean_level = 1.0

    def __getstate__(self) -> dict[str, object]:
        """With the evidence that is elsewhere."""
        self._collect()
        return vars(self)

    def level(self, key: int) -> float:
        """Brightness of a view relative to the scene's."""
        return self._levels.get(key, self._mean_level) / self._mean_level

    def factor(self, key: int) -> Image:
        """Gain times brightness of a view, [H, W]: the factor of its render."""
        return np.asarray(self.gain * np.float32(self.level(key)), np.float32)

    def observe(self, key: int, rendered: Image, observed: Image, deviation: Image, gains: bool = True) -> None:
        """Take one view's render [H, W] (without nuisances), its rates and their deviations
        (infinite where nothing was seen).

        Without `gains` only the view's brightness is estimated.
        """
        seen = np.ascontiguousarray(rendered), np.ascontiguousarray(observed), np.ascontiguousarray(deviation)
        # A ratio of means: least squares underestimates the brightness while the map is rough, and the map follows.
        # Weights by precision would give most weight to the darkest pixels.
        expected, light = agreement(self.gain, *seen, MODEL_ERROR, AGREEING_SIGMAS)
        self.compare(key, expected, light)
        if not gains:
            return
        self._collect()
        gain_evidence(self.gain, *seen, self.level(key), MODEL_ERROR, self._xx, self._xy)
        self._observed += 1

    def compare(self, key: int, expected: float, light: float) -> None:
        """Take the light of the pixels of a view that agree with the map: what was expected of them and observed."""
        if expected > 0:
            self.note(key, light / expected)

    def expect(self, evidence: Evidence) -> None:
        """Count a view whose residuals are going to be added to `evidence`, which goes on with the sums so far."""
        if evidence is not self._elsewhere:
            self._collect()
            evidence.set_evidence(self._xx, self._xy)
        self._elsewhere = evidence
        self._observed += 1

    def _collect(self) -> None:
        if self._elsewhere is not None:
            self._xx, self._xy = self._elsewhere.evidence()
            self._elsewhere = None

    def note(self, key: int, brightness: float) -> None:
        """Set the brightness of a view over its render without nuisances."""
        self._levels[key] = brightness
        self._mean_level = float(np.mean(list(self._levels.values())))

    def update(self) -> None:
        """Estimate the gains from the accumulated residuals."""
        if not self._observed:
            return
        self._collect()
        # A view observed again adds no information: the evidence is that of the distinct views.
        once = np.float32(min(1.0, len(self._levels) / self._observed))
        if not self._fixed:
            relative = once * self._xy / (once * self._xx + np.float32(1 / GAIN_SIGMA**2))
            gain = np.clip(1 + relative, *GAIN_LIMITS)
            self.gain = (gain / np.exp(np.log(gain).mean())).astype(np.float32)
        self._xx *= RESIDUAL_DECAY
        self._xy *= RESIDUAL_DECAY
        self._observed *= RESIDUAL_DECAY

    def forget_views(self) -> None:
        """Drop what is stored for each view, after some were dropped."""
        self._elsewhere = None
        self._levels.clear()
        self._xx[:] = self._xy[:] = 0
        self._observed = 0.0
