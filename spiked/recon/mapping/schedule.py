"""The schedule of a map's steps: image size, learning rates, alignments and the number of steps."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Schedule:
    """When what happens in a refinement, by the share of it that is done: 0 to 1, of its steps or of its time limit."""

    coarse_share: float = 0.6
    """Share in which large images are fitted at smaller pyramid levels, a quarter of the work each (decision 5)."""
    rate_decades: float = 1.0
    """Decimal powers by which all learning rates fall (decision 3)."""
    settling_share: float = 0.15
    """Last share, in which the rates fall to zero: otherwise the map follows the last views' noise (decision 3)."""
    align_at: tuple[float, ...] = (0.14, 0.28, 0.42, 0.56, 0.7)
    """Shares at which the whole path is aligned with the map; it is fixed after the last (decision 13)."""
    align_long_at: tuple[float, ...] = (0.6, 0.7, 0.8)
    """The same of a path that is interpolated between views: images have their full size by then (decision 58)."""
    small_pixels: int = 130_000
    """Images up to this size get the full number of steps."""
    large_power: float = 0.4
    """The steps of larger images fall with this power of their pixels: a compromise of cost and convergence (decision
    13)."""
    fast_steps: float = 3.0
    """Factor on the steps for views of fast motion: a step costs less and carries less fine detail (decisions 13 and
    65)."""
    live_steps: int = 800
    """Steps of a live map from the coarsest pyramid level to full size."""
    stale_px: float = 0.05
    """Rebuild the map if the path moved > 0.05 px (90th percentile of the views). With 0.3 px the ATE of living tracked
    live is 0.08 instead of 0.05 %, and 6.5 instead of 3.9 % where the camera moves by a hundredth of the scene's
    depth."""

    def steps(self, most: int, pixels: int, fast: float, extent: float = 1.0) -> int:
        """Steps of a refinement, `most` for small images and a short path, for a share `fast` of views of fast motion.

        `extent` is the size of the map, see `MapOptions.extent_px`.
        """
        share = min(1.0, float((self.small_pixels / pixels) ** self.large_power))
        return round(most * share * (1 + (self.fast_steps - 1) * fast) * extent)

    def coarseness(self, share: float) -> float:
        """Pyramid level from 0 (full size) to 1 (smallest)."""
        return max(0.0, 1 - share / self.coarse_share)

    def live_coarseness(self, steps: int) -> float:
        """As `coarseness`, after that many steps of a live map."""
        return max(0.0, 1 - steps / self.live_steps)

    def rate(self, share: float) -> float:
        """Factor on all learning rates."""
        return float(10 ** (-self.rate_decades * share) * min(1.0, (1 - share) / self.settling_share))

    def alignment_step(self, number: int) -> float:
        """Share of the full Gauss-Newton step for alignment `number`, from 1 on.

        Damped: with full steps errors of the map turn the path into a random walk.
        """
        return 2 / (1 + number)
