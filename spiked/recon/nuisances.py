"""What stands between the scene and the counts: each pixel's gain, and the brightness of the whole image over time."""

import numpy as np

from spiked.recon.views import Image

PIXEL_RIDGE = 0.02
"""Prior deviation of a pixel's gain from 1."""
MODEL_ERROR = 0.07
"""What the map is wrong by, relative to the value: no residual says more than this allows."""
FORGET = 0.7
"""Weight of what was seen before each update: older residuals are of an older map."""


class Nuisances:
    """Estimates gain(x) and a level for each view in `observed = gain(x) * level * rendered`.

    Closed-form weighted regressions; the gains have a ridge towards 1 and mean log gain 0. The levels are relative to
    each other: their mean belongs to the brightness of the scene.
    """

    def __init__(self, height: int, width: int, fixed: Image | None = None) -> None:
        """`fixed` [H, W] are gains known from a calibration; those are kept."""
        self.gain: Image = np.ones((height, width), np.float32) if fixed is None else fixed.astype(np.float32)
        self._fixed = fixed is not None
        self._xx = np.zeros((height, width), np.float32)
        self._xy = np.zeros((height, width), np.float32)
        self._observed = 0.0
        self._levels: dict[int, float] = {}
        self._mean_level = 1.0

    def level(self, key: int) -> float:
        """The brightness of a view relative to the scene's."""
        return self._levels.get(key, self._mean_level) / self._mean_level

    def factor(self, key: int) -> Image:
        """What multiplies the render of a view, [H, W]."""
        return np.asarray(self.gain * np.float32(self.level(key)), np.float32)

    def observe(self, key: int, rendered: Image, observed: Image, deviation: Image, gains: bool = True) -> None:
        """Take one view's render [H, W] (without nuisances), its rates and their deviations
        (infinite where nothing was seen).

        Without `gains` only the view's level is learnt from it.
        """
        expected = self.gain * rendered
        error = MODEL_ERROR * (expected + observed)
        precision = 1 / (deviation * deviation + error * error + 1e-12)
        # A ratio of means: a least-squares slope would come out low for as long as the map is rough, and drag it along.
        # Nor may the dark pixels speak loudest, as weights by precision let them.
        agree = (np.abs(observed - expected) < 3 * (deviation + error)) & np.isfinite(deviation)
        total = float(expected[agree].sum())
        if total > 0:
            self.note(key, float(observed[agree].sum()) / total)
        if not gains:
            return
        model = rendered * np.float32(self.level(key))
        self._xx += precision * model * model
        self._xy += precision * model * (observed - model)
        self._observed += 1

    def note(self, key: int, brightness: float) -> None:
        """A view is so many times as bright as its render without nuisances."""
        self._levels[key] = brightness
        self._mean_level = float(np.mean(list(self._levels.values())))

    def update(self) -> None:
        """New gains from all that was observed."""
        if not self._observed:
            return
        # A view seen again tells nothing new: the evidence is that of the distinct views.
        once = np.float32(min(1.0, len(self._levels) / self._observed))
        if not self._fixed:
            relative = once * self._xy / (once * self._xx + np.float32(1 / PIXEL_RIDGE**2))
            gain = np.clip(1 + relative, 0.5, 2.0)
            self.gain = (gain / np.exp(np.log(gain).mean())).astype(np.float32)
        self._xx *= FORGET
        self._xy *= FORGET
        self._observed *= FORGET

    def forget_views(self) -> None:
        """Views are numbered anew."""
        self._levels.clear()
        self._xx[:] = self._xy[:] = 0
        self._observed = 0.0
