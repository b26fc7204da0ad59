"""The unit of length of a scene in metres, and which way is up: what a moving camera alone cannot know."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.harmonics import rotated_harmonics
from spiked.pose import quaternion, rotation_of
from spiked.scene import Scene, unit_quats
from spiked.trajectory import Trajectory

__all__ = ["FrameOfReference", "KnownScale"]

Array = NDArray[np.float64]

DOWN = np.array([0.0, 1.0, 0.0])
"""Downwards in the axes of OpenCV."""


@dataclass(frozen=True)
class KnownScale:
    """What a file says of its unit of length and its axes; None where it is not known."""

    unit: Literal["scene", "m"] = "scene"
    metres_per_unit: float | None = None
    scale_sigma: float | None = None
    """Relative standard deviation of the scale, of a file in metres that of all its lengths."""
    up: tuple[float, float, float] | None = None
    """Direction of up in the axes of the file, of length 1."""

    @property
    def in_metres(self) -> "KnownScale":
        """The same of a file in metres, with up along -y where up is known."""
        return KnownScale("m", 1.0, self.scale_sigma, None if self.up is None else (0.0, -1.0, 0.0))

    @property
    def known(self) -> dict[str, Any]:
        """The unit, and what is known of it, for files that hold names with values."""
        values = {"metres_per_unit": self.metres_per_unit, "scale_sigma": self.scale_sigma}
        listed = {"up": None if self.up is None else list(self.up)}
        return {"unit": self.unit} | {name: value for name, value in (values | listed).items() if value is not None}

    @property
    def texts(self) -> dict[str, str]:
        """The same as texts."""
        return {
            name: " ".join(map(repr, value)) if isinstance(value, list) else str(value)
            for name, value in self.known.items()
        }

    @property
    def notes(self) -> list[str]:
        """The same as comments, one a line; none while nothing is known."""
        return [f"{name} {text}" for name, text in self.texts.items()] if len(self.known) > 1 else []


@dataclass(frozen=True)
class FrameOfReference:
    """A change from the axes and the unit of a scene to upright axes and metres; the origin stays."""

    metres_per_unit: float = 1.0
    up: tuple[float, float, float] | None = None
    """Direction of up in the scene; None: its axes stay."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.metres_per_unit) and self.metres_per_unit > 0):
            raise ConfigurationError(f"{self.metres_per_unit!r} metres for a unit: a positive number is needed")
        if self.up is not None and not 0 < float(np.linalg.norm(self.up)) < np.inf:
            raise ConfigurationError(f"up is {self.up}: a direction is needed")

    @property
    def direction(self) -> tuple[float, float, float] | None:
        """`up` with length 1."""
        if self.up is None:
            return None
        x, y, z = (float(part / np.linalg.norm(self.up)) for part in self.up)
        return x, y, z

    @property
    def rotation(self) -> Array:
        """The shortest turn that takes down to +y, [3, 3]."""
        if self.up is None:
            return np.eye(3)
        down = -np.array(self.up) / np.linalg.norm(self.up)
        axis, cosine = np.cross(down, DOWN), float(down @ DOWN)
        if cosine < -1 + 1e-9:
            return np.diag([1.0, -1.0, -1.0])
        x, y, z = axis
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))

    def points(self, points: Array) -> Array:
        """Points [..., 3] of the scene in metres."""
        return np.asarray(self.metres_per_unit * points @ self.rotation.T)

    def scene(self, scene: Scene) -> Scene:
        """The scene in metres."""
        turned = quaternion(self.rotation @ rotation_of(unit_quats(scene.quats)))
        return replace(
            scene,
            means=self.points(scene.means.astype(np.float64)).astype(np.float32),
            quats=turned.astype(np.float32),
            log_scales=scene.log_scales + np.float32(np.log(self.metres_per_unit)),
            harmonics=None if scene.harmonics is None else rotated_harmonics(scene.harmonics, self.rotation),
        )

    def trajectory(self, path: Trajectory) -> Trajectory:
        """The path in metres."""
        return Trajectory(path.times_s, self.rotation @ path.rotations, self.points(path.centres))
