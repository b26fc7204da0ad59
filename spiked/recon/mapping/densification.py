"""Densification: where splats are added, and which are replaced."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.sensor import Image


@dataclass(frozen=True)
class DensifyStrategy:
    """Adds splats where the render of a view is wrong, first in place of dead ones.

    3D Gaussian splatting (Kerbl et al., 2023) clones and splits splats of large positional gradients; here pixels are
    drawn in proportion to their error, and each becomes a splat at the depth of the render.
    """

    every: int = 20
    """Steps between densifications, each in the view of that step (decision 5)."""
    until: float = 0.7
    """Share of a refinement with densification; after it the splats only converge."""
    share: float = 0.03
    """Most splats added at a time, as a share of the cap; dead splats are replaced beyond that (decision 65)."""
    fast_share: float = 0.02
    """The same where most views see fast motion: their refinements have more steps (decision 8)."""
    dead_logit: float = -4.0
    """A splat of a lower opacity logit, an opacity below 0.018, is replaced; 3DGS prunes below 0.005."""
    noise_px: float = 0.7
    """Standard deviation of the blur of the signed error: noise averages out, an error of the map does not."""
    spread_px: float = 1.0
    """Standard deviation of the blur of the absolute error: a new splat may lie beside its largest error."""

    def due(self, steps: int, share: float) -> bool:
        """Whether to densify after that many steps, at that share of the refinement (0 for a live map)."""
        return share < self.until and steps % self.every == 0

    def dead(self, opacity_logits: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Splats to be replaced, [N]."""
        return np.asarray(opacity_logits < self.dead_logit)

    def badness(self, error: Image) -> Image:
        """Weight of each pixel [H, W] for a new splat, from a signed error [H, W] or [H, W, C]; 0 up to the median."""
        smooth = cv2.GaussianBlur(error, (0, 0), self.noise_px)
        badness = cv2.GaussianBlur(np.abs(smooth), (0, 0), self.spread_px)
        badness = badness.sum(-1) if badness.ndim == 3 else badness
        return np.asarray(np.maximum(badness - np.median(badness), 0))

    def share_of(self, fast: bool) -> float:
        """Most splats added at a time, for views of slow or of fast motion."""
        return self.fast_share if fast else self.share

    def choose(
        self, error: Image, replaced: int, cap: int, headroom: int, rng: np.random.Generator, *, fast: bool = False
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Rows and columns of the pixels that become splats; None if there is no headroom or no error.

        `replaced` splats were removed, `headroom` is left below the `cap`; `fast`: most views see fast motion.
        """
        badness = self.badness(error)
        count, total = min(int(self.share_of(fast) * cap) + replaced, headroom), float(badness.sum())
        if count < 1 or total <= 0:
            return None
        count = min(count, badness.size // 4)
        chosen = rng.choice(badness.size, count, replace=False, p=(badness / total).ravel())
        rows, columns = np.divmod(chosen, badness.shape[1])
        return rows, columns
