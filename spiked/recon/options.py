"""Options of a reconstruction."""

from dataclasses import dataclass, field, replace

from spiked.calibration import Calibration
from spiked.errors import ConfigurationError
from spiked.recon.frontend.spike_targets import TargetKind
from spiked.recon.mapping.loss import LossName
from spiked.recon.mapping.options import MapOptions
from spiked.trajectory import Trajectory

__all__ = ["LossName", "MapOptions", "Options"]


@dataclass(frozen=True)
class Options:
    """A reconstruction's options; the defaults suit a hand-held camera."""

    window_frames: int | None = None
    """Frames of a view; None follows the motion (4 to 64)."""
    steps: int = 2000
    """Gradient steps of the final refinement; images of more than 130,000 pixels get fewer, as each costs more,
    and fast motion gets up to 2.5 times as many."""
    seed: int = 0
    """Seed of all random choices: the same input, options and seed give the same result."""
    threads: int | None = None
    """Threads of the rasteriser; None takes all cores."""
    max_views: int = 400
    """Views kept for mapping; beyond it those are dropped between whose neighbours the camera moved least."""
    memory_mb: int = 512
    """MiB of images in memory, those of views and of keyframes; the others are built anew from the recording. Without a
    recording fewer are kept."""
    poses: Trajectory | None = None
    """Given camera poses: the map is fitted to them and they are not changed."""
    calibration: Calibration | None = None
    """The camera's gains, dark rates and defects, from `spiked calibrate`."""
    refine_poses: bool = True
    """Whether the map corrects the trajectory."""
    loss: LossName | None = None
    """What the map is fitted to; None: `mapping.loss`."""
    mapping: MapOptions = field(default_factory=MapOptions)

    def __post_init__(self) -> None:
        if self.window_frames is not None and not 2 <= self.window_frames <= 256:
            raise ConfigurationError(f"window of {self.window_frames} frames is outside 2 to 256")
        if self.steps < 0:
            raise ConfigurationError(f"refinement of {self.steps} steps is negative")
        if self.max_views < 20:
            raise ConfigurationError(f"{self.max_views} views are too few to map from; 20 is the least")
        if self.memory_mb < 16:
            raise ConfigurationError(f"{self.memory_mb} MiB for images are too few; 16 is the least")

    @property
    def fitted(self) -> MapOptions:
        """The options of the map, with `loss` where it is given."""
        return self.mapping if self.loss is None else replace(self.mapping, loss=self.loss)

    @property
    def targets(self) -> tuple[TargetKind, ...]:
        """What views record for the loss."""
        kind = self.fitted.loss.target
        return () if kind is None else (kind,)
