"""Options of a reconstruction."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spiked.calibration import Calibration
from spiked.errors import ConfigurationError
from spiked.recon.frontend.spike_targets import TargetKind
from spiked.recon.mapping.loss import LossName
from spiked.recon.mapping.options import MapOptions
from spiked.recon.methods import Initialisation, Method, MethodName, PoseStepName, method_of
from spiked.trajectory import Trajectory

__all__ = ["Initialisation", "LossName", "MapOptions", "MethodName", "Options", "PoseStepName"]


@dataclass(frozen=True)
class Options:
    """A reconstruction's options; the defaults suit a hand-held camera."""

    window_frames: int | None = None
    """Frames of a view; None follows the motion (4 to 64)."""
    steps: int = 1600
    """Gradient steps of the final refinement; images of more than 130,000 pixels get fewer, as each costs more,
    and fast motion gets up to three times as many."""
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
    method: MethodName = MethodName.SPIKED
    """Name of one of `spiked.recon.methods.METHODS`; the next three options replace parts of it."""
    initialisation: Initialisation | None = None
    """How the path begins; None: as in the method."""
    first_depth: NDArray[np.float64] | None = None
    """Depth [H, W] of the first view in any unit, for `Initialisation.PROGRESSIVE`; without it all of it is at one
    depth, from which the path is not found (docs/paper.md). Values that are not positive and finite are not known."""
    pose_step: PoseStepName | None = None
    """What corrects the poses; None: as in the method."""
    loss: LossName | None = None
    """What the map is fitted to; None: as in the method, or `mapping.loss` where that is not the default."""
    mapping: MapOptions = field(default_factory=MapOptions)

    def __post_init__(self) -> None:
        if self.window_frames is not None and not 2 <= self.window_frames <= 256:
            raise ConfigurationError(f"window of {self.window_frames} frames is outside 2 to 256")
        method = method_of(self.method)
        if self.initialisation is Initialisation.PROGRESSIVE and method.alternation is None:
            raise ConfigurationError(
                f"the method {self.method} needs a path before its map: the initialisation {self.initialisation} is "
                "of the method nope-sgs"
            )
        if self.first_depth is not None:
            if self.parts.initialisation is not Initialisation.PROGRESSIVE:
                raise ConfigurationError(
                    "a depth of the first view is for a path that grows with its map: give it with the method nope-sgs"
                )
            if not (np.isfinite(self.first_depth) & (self.first_depth > 0)).any():
                raise ConfigurationError("the depth of the first view has no value that is positive and finite")
        if self.steps < 0:
            raise ConfigurationError(f"refinement of {self.steps} steps is negative")
        if self.max_views < 20:
            raise ConfigurationError(f"{self.max_views} views are too few to map from; 20 is the least")
        if self.memory_mb < 16:
            raise ConfigurationError(f"{self.memory_mb} MiB for images are too few; 16 is the least")

    @property
    def parts(self) -> Method:
        """The method with the parts that replace its own."""
        method = method_of(self.method)
        begin = self.initialisation if self.poses is None else Initialisation.TRACKS
        return replace(
            method,
            initialisation=begin or method.initialisation,
            pose_step=self.pose_step or method.pose_step,
            loss=self.loss or method.loss,
        )

    @property
    def fitted(self) -> MapOptions:
        """The options of the map, with what the method changes of them."""
        mapping = self.parts.fitted(self.mapping)
        return mapping if self.loss is None else replace(mapping, loss=self.loss)

    @property
    def targets(self) -> tuple[TargetKind, ...]:
        """What views record for the losses."""
        kinds = {self.fitted.loss.target}
        if self.parts.initialisation is Initialisation.PROGRESSIVE:
            kinds.add(LossName.INTERVAL.target)
        return tuple(sorted(kind for kind in kinds if kind is not None))
