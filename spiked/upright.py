"""Which way is up in a scene: by gravity that another instrument measured, or by its floor."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, SceneError
from spiked.scene import Scene
from spiked.trajectory import Trajectory

__all__ = ["Floor", "find_floor", "up_by_gravity", "up_by_points"]

Array = NDArray[np.float64]

TRIALS = 2000
"""Planes that are tried, each through a splat along the surface there."""
SAMPLE = 20_000
"""Splats that the planes are tried with, at most."""
THICK = 0.01
"""Distance of the splats of a floor from its plane, at most, over the median distance of the scene from the cameras."""
BELOW = 0.02
"""Share of the splats that may lie below a floor: a table has legs, a floor has nothing."""
LEAST_SHARE = 0.03
"""Share of the splats on a floor, at least."""
MOST_TILT_DEG = 50.0
"""Angle between up and the mean of the cameras' upward axes, at most."""
CELL = 4.0
"""Side of the cells that the area of a plane is counted in, over `THICK`."""
NEIGHBOURS = 16
"""Splats that the normal of the surface is fitted to."""
MOST_TURN_DEG = 25.0
"""Angle between the normal of a floor and that of the surface at its splats, at most."""
LEAST_CELLS = 60
"""Cells of a floor, at least."""
SOLID = 0.5
"""Opacity of the splats that count."""
STRAIGHT = 0.02
"""Second extent of points over their first one below which they lie on a line."""

NO_FLOOR = "no floor is seen in the scene: give three points of it, or the direction of up"
"""What is said without one."""


@dataclass(frozen=True)
class Floor:
    """The floor of a scene."""

    up: Array
    """Direction in the scene, of length 1, [3]."""
    share: float
    """Of the splats on it."""


def up_by_gravity(gravity: Sequence[float] | Array, rotation: Array) -> Array:
    """Up in the scene, [3], by gravity in the axes of a camera (x right, y down, z forward) of this rotation.

    Raises ConfigurationError for a vector without a direction.
    """
    down = rotation @ np.asarray(gravity, np.float64)
    length = float(np.linalg.norm(down))
    if not 0 < length < np.inf:
        raise ConfigurationError(f"gravity is {tuple(map(float, gravity))}: a direction is needed")
    return np.asarray(-down / length)


def up_by_points(points: Array, cameras: Array) -> Array:
    """Up, [3], by three or more points of the floor, [n, 3], below the cameras, [m, 3].

    Raises ConfigurationError for fewer points or points on a line.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3 or not np.isfinite(points).all():
        raise ConfigurationError(f"the floor needs three points x,y,z or more; got an array of shape {points.shape}")
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extents[1] < STRAIGHT * max(float(extents[0]), 1e-300):
        raise ConfigurationError("the points of the floor lie on a line: choose three that span a triangle")
    normal = axes[2]
    return np.asarray(normal if float(((cameras - middle) @ normal).mean()) >= 0 else -normal)


def find_floor(scene: Scene, path: Trajectory, seed: int = 0) -> Floor:
    """The plane with the largest area of surface along it that has almost nothing below it and all cameras above.

    Raises SceneError if there is none.
    """
    rng = np.random.default_rng(seed)
    solid = scene.means[scene.opacities >= SOLID].astype(np.float64)
    points = solid[rng.permutation(len(solid))[:SAMPLE]]
    if len(points) <= NEIGHBOURS or not len(path):
        raise SceneError("the scene has too few solid splats for a floor: give three points of it")
    normals = _normals(points)
    towards = -path.rotations[:, :, 1].mean(axis=0)
    normals *= np.where(normals @ towards < 0, -1, 1)[:, None]
    upward = normals @ towards > np.cos(np.radians(MOST_TILT_DEG)) * np.linalg.norm(towards)
    thick = THICK * float(np.median(np.linalg.norm(points - path.centres.mean(axis=0), axis=1)))
    best, most = None, 0
    for row in rng.permutation(np.flatnonzero(upward))[:TRIALS]:
        on = _on_floor(points, normals, path.centres, normals[row], points[row], thick)
        cells = 0 if on is None else _cells(points[on], normals[row], CELL * thick)
        if cells > most:
            best, most = on, cells
    for _ in range(3):
        if best is not None:
            up, middle = _up_of(points[best], path.centres), points[best].mean(axis=0)
            best = _on_floor(points, normals, path.centres, up, middle, thick)
    if best is None or _cells(points[best], up, CELL * thick) < LEAST_CELLS:
        raise SceneError(NO_FLOOR)
    return Floor(_up_of(points[best], path.centres), float(best.mean()))


def _up_of(points: Array, cameras: Array) -> Array:
    """As `up_by_points`. Raises SceneError for points that span no plane: few splats may be on a floor by chance."""
    try:
        return up_by_points(points, cameras)
    except ConfigurationError as error:
        raise SceneError(NO_FLOOR) from error


def _normals(points: Array) -> Array:
    """Normals of the surface at points, [n, 3], by their neighbours; of either sign."""
    _, near = scipy.spatial.cKDTree(points).query(points, NEIGHBOURS)
    away = points[near] - points[near].mean(axis=1, keepdims=True)
    return np.linalg.eigh(away.swapaxes(1, 2) @ away)[1][:, :, 0]


def _on_floor(
    points: Array, normals: Array, cameras: Array, up: Array, at: Array, thick: float
) -> NDArray[np.bool_] | None:
    """Which points lie on a plane and have its normal, [n]; None if it is no floor."""
    height = (points - at) @ up
    if (height < -3 * thick).mean() > BELOW or ((cameras - at) @ up).min() < thick:
        return None
    on = np.asarray((np.abs(height) < thick) & (normals @ up > np.cos(np.radians(MOST_TURN_DEG))))
    return on if on.mean() >= LEAST_SHARE else None


def _cells(points: Array, up: Array, side: float) -> int:
    """Cells of a plane that hold points."""
    along = np.linalg.svd(up[None])[2][1:]
    column, row = np.floor(points @ along.T / side).astype(np.int64).T
    return len(np.unique(column * (1 << 32) + row))
