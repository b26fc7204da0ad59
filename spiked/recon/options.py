"""What a user can choose about a reconstruction."""

from dataclasses import dataclass, field

from spiked.calibration import Calibration
from spiked.errors import ConfigurationError
from spiked.trajectory import Trajectory


@dataclass(frozen=True)
class MapOptions:
    """How the map is fitted. Lengths are relative to the median depth of the scene, which is 1."""

    stride_px: float = 2.0
    """Spacing of the pixels that become the first splats."""
    splats_a_pixel: float = 0.8
    """Cap of the number of splats, in splats for each sensor pixel."""
    most_splats: int = 250_000
    """Cap of the number of splats, however many pixels there are."""
    rate_means: float = 2e-3
    """Learning rates at the start, per step; those of the means and of colour are in units of depth and of white."""
    rate_quats: float = 2.5e-2
    rate_scales: float = 1e-1
    rate_opacities: float = 8e-2
    rate_colours: float = 1.5e-2
    ssim: float = 0.2
    """Share of structural similarity in the loss of grey views, as in 3D Gaussian splatting."""
    sub_frames: int | None = None
    """Pieces of straight motion that a view is rendered in; None follows the motion, 0 lets the camera stand still."""
    nuisances: bool = True
    """Estimate each pixel's gain and the brightness of each view (flicker, lamps)."""
    background: float = 0.5
    """Brightest background that is set behind the map while it is fitted, in units of white; 0 is black always."""
    floor: float = 0.03
    """Part of the scene's white added to the noise of each pixel: small values trust dark pixels more."""


@dataclass(frozen=True)
class Options:
    """A reconstruction's options; the defaults suit a hand-held camera."""

    window_frames: int | None = None
    """Frames of a view; None follows the motion (8 to 64)."""
    steps: int = 2000
    """Gradient steps of the final refinement; images of more than 130,000 pixels get fewer, as each costs more,
    and fast motion gets up to 1.8 times as many."""
    seed: int = 0
    """Seed of everything random: the same input, options and seed give the same result."""
    threads: int | None = None
    """Threads of the rasteriser; None takes all cores."""
    max_views: int = 400
    """Views kept for mapping; beyond it every second of the older ones is let go."""
    poses: Trajectory | None = None
    """Known camera poses: the map is fitted to them and they are not changed."""
    calibration: Calibration | None = None
    """The camera's gains, dark rates and defects, from `spiked calibrate`."""
    refine_poses: bool = True
    """Whether the map corrects the trajectory."""
    mapping: MapOptions = field(default_factory=MapOptions)

    def __post_init__(self) -> None:
        if self.window_frames is not None and not 2 <= self.window_frames <= 256:
            raise ConfigurationError(f"window of {self.window_frames} frames is outside 2 to 256")
        if self.steps < 0:
            raise ConfigurationError(f"refinement of {self.steps} steps is negative")
        if self.max_views < 20:
            raise ConfigurationError(f"{self.max_views} views are too few to map from; 20 is the least")
