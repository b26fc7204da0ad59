"""Learning rates of the map."""

from dataclasses import dataclass

from spiked.render.splats import MeanAxes


@dataclass(frozen=True)
class Rates:
    """Learning rates at the start of a refinement, per step."""

    means: float
    """Along the axes of each splat, in units of its standard deviations; without `blur_px` along the axes of the world,
    in units of the scene's typical depth."""
    blur_px: float | None
    """What is added to these standard deviations by squares, as seen at the scene's typical depth: thin splats move,
    too."""
    scales: float
    """Of the logarithms of the scales."""
    colours: float
    """Of the colours, in units of white."""
    quats: float = 2.5e-2
    """Of the quaternions (decision 3)."""
    opacities: float = 8e-2
    """Of the opacity logits (decision 6)."""

    def of_arrays(self, white: float) -> tuple[float, ...]:
        """Of a scene's five arrays, that of the means in units of `axes`."""
        return self.means, self.quats, self.scales, self.opacities, self.colours * white

    def axes(self, depth: float, focal_px: float) -> MeanAxes:
        """What means move along, in a scene of that typical depth."""
        return MeanAxes(depth) if self.blur_px is None else MeanAxes(self.blur_px * depth / focal_px, own=True)


RATES = Rates(means=0.35, blur_px=1.0, scales=1.5e-1, colours=3e-2)
"""Those of views over their windows (decision 65)."""
FAST_RATES = Rates(means=2e-3, blur_px=None, scales=1e-1, colours=1.5e-2)
"""Those of the charge of fast motion: paths of garden_fast are better with them (decisions 3, 6 and 65)."""
