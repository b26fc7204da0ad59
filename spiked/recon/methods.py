"""Methods of reconstruction: what each is made of. `METHODS` is the registry; docs/paper.md compares them.

A method has four parts, which can be mixed: how the path begins, what corrects the poses, what the map is fitted to
(`LossName`), and in which order (its schedule).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from spiked.errors import ConfigurationError
from spiked.recon.mapping.loss import LossName
from spiked.recon.mapping.options import MapOptions


class MethodName(StrEnum):
    """The names of `METHODS`."""

    SPIKED = "spiked"
    NOPE_SGS = "nope-sgs"


class Initialisation(StrEnum):
    """How the path begins."""

    TRACKS = "tracks"
    """Tracked corners, a five-point hypothesis among others, bundle adjustment: a path before any map."""
    PROGRESSIVE = "progressive"
    """No tracks: the interval image of the first view as a flat scene, then one view after the other."""


class PoseStepName(StrEnum):
    """What corrects the poses while the map is fitted."""

    ALIGNMENT = "alignment"
    """Gauss-Newton over the whole path with landmarks marginalised."""
    GRADIENT = "gradient"
    """The rasteriser's exact gradient by the pose of each sub-frame (Eq 6 to 12), divided by its curvature."""
    DIFFERENCE = "difference"
    """The same gradient of the difference of two renders 32 frames apart (Eq 6 to 8), which ends less near."""


@dataclass(frozen=True)
class Alternation:
    """Schedule of Nope-SGS: pose steps and scene steps in turn, on key frames."""

    pose_steps: int = 500
    """Pose steps of an epoch."""
    scene_steps: int = 1000
    """Scene steps of an epoch. With fewer steps in all than `least_epochs` need, epochs are shortened in proportion."""
    least_epochs: int = 3
    """Epochs at least."""
    chunk: int = 25
    """Pose steps between two looks at the clock."""
    first_steps: int = 100
    """Scene steps on the first view before the second is added."""
    growth_share: float = 0.5
    """Share of the steps in which views are added, where the path grows with the map."""
    recent_views: int = 8
    """Newest views that half of the steps of the growth are taken on."""
    key_frames: bool = True
    """Steps are taken on views whose loss exceeds the mean; chosen anew twice an epoch."""


@dataclass(frozen=True)
class Method:
    """A method of reconstruction."""

    name: MethodName
    summary: str
    """What it is, in a line."""
    initialisation: Initialisation = Initialisation.TRACKS
    pose_step: PoseStepName = PoseStepName.ALIGNMENT
    loss: LossName = LossName.CHARGE
    alternation: Alternation | None = None
    """Schedule of the refinement; None: that of `MapOptions.schedule`."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Options of the map that differ from their defaults; those that the caller has changed stay."""

    def fitted(self, mapping: MapOptions) -> MapOptions:
        """Options of the map with those of the method."""
        default = MapOptions()
        wanted = {"loss": self.loss, **self.changes}
        return replace(
            mapping, **{name: of for name, of in wanted.items() if getattr(mapping, name) == getattr(default, name)}
        )


METHODS = {
    method.name: method
    for method in (
        Method(MethodName.SPIKED, "tracks, charge between spikes, Gauss-Newton alignment"),
        Method(
            MethodName.NOPE_SGS,
            "3D Gaussian Splatting from Unposed Spike Streams (CVPR 2026), as its supplement describes it",
            Initialisation.PROGRESSIVE,
            PoseStepName.GRADIENT,
            LossName.ACCUMULATION_BINOMIAL,
            Alternation(),
            {"nuisances": False, "blur_matched": False, "sub_frames": 4},
        ),
    )
}
"""All methods by name."""


def method_of(name: str) -> Method:
    """The method of a name. Raises ConfigurationError for another one."""
    if name not in set(MethodName):
        raise ConfigurationError(f"there is no method {name!r}: choose one of {', '.join(METHODS)}")
    return METHODS[MethodName(name)]
