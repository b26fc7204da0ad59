"""The index of a map: reference views along its path, with features and their 3D points."""

from dataclasses import dataclass

import numpy as np

from spiked.errors import SceneError
from spiked.pose import Array, log_so3
from spiked.recon.frontend.features import Features, find_features
from spiked.recon.frontend.retrieval import Retrieval
from spiked.recon.localisation.map_views import MapRenderer, MapView
from spiked.recon.odometry.sparse_map import Pose
from spiked.recon.statistics import median
from spiked.render import Camera
from spiked.scene import Scene
from spiked.trajectory import Trajectory

STRIDE_PX = 10.0
"""Image motion along the path from one place that may become a reference to the next, as `SPACING_PX`."""
SPACING_PX = 40.0
"""A place becomes a reference if the image of every other reference is shifted by more than this, in px at a width of
`NOMINAL_WIDTH_PX`."""
NOMINAL_WIDTH_PX = 400
"""Width of images in which `STRIDE_PX` and `SPACING_PX` are given."""
REFERENCE_FEATURES = 500
"""Features of a reference, at most."""
LEAST_FEATURES = 30
"""Features that a reference needs: with fewer it can never be recognised."""
GRID = (6, 4)
"""Columns and rows of the pixels by which the shift between two views is measured."""


@dataclass(frozen=True)
class Reference:
    """The map from one pose of its path."""

    pose: Pose
    features: Features
    points: Array
    """[n, 3] of the features."""


class MapIndex:
    """Where a camera can be recognised in a map: its reference views and their features."""

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        camera: Camera,
        threads: int | None = None,
    ) -> None:
        """Render references along `trajectory`, whose poses are in the frame of reference of `scene`, for `camera`.

        That is the camera that will be localised; it may differ from the one that made the map.
        Raises SceneError for a map without splats, without poses or without texture.
        """
        if len(scene) == 0 or len(trajectory) == 0:
            raise SceneError("the map is empty: reconstruct a recording first")
        self.renderer = MapRenderer(scene, camera, threads)
        self.camera = camera
        self.trajectory = trajectory
        self.references: list[Reference] = []
        self._grids: list[Array] = []
        self._spacing_px = SPACING_PX * camera.width / NOMINAL_WIDTH_PX
        for pose in self._places():
            if not self._grids or self.shifts_px(pose).min() > self._spacing_px:
                self._add(self.renderer.render(pose))
        if not self.references:
            raise SceneError("nothing in the map can be recognised: its renders have no texture")
        self._retrieval = Retrieval([one.features for one in self.references])

    def __len__(self) -> int:
        return len(self.references)

    def _places(self) -> list[Pose]:
        """Poses along the path, `STRIDE_PX` of image motion apart."""
        path, travelled = self.trajectory, travelled_px(self.renderer, self.trajectory)
        stride = STRIDE_PX * self.camera.width / NOMINAL_WIDTH_PX
        rows = np.unique(np.searchsorted(travelled, np.arange(0, travelled[-1] + 1e-9, stride)))
        return [Pose(path.rotations[row], path.centres[row]) for row in rows]

    def shifts_px(self, pose: Pose) -> Array:
        """Median image motion [R] from each reference to a pose; infinite where most of it is not seen."""
        local = (np.stack(self._grids) - pose.centre) @ pose.rotation
        at = self.camera.intrinsics.project(local)
        pixels = _grid(self.camera)
        size = np.linalg.norm(at - pixels, axis=2)
        size[(local[..., 2] <= 0) | ~np.isfinite(size)] = np.inf
        return np.asarray(np.median(size, axis=1))

    def _add(self, view: MapView) -> None:
        pixels = _grid(self.camera)
        points, sound = view.points(pixels)
        if not sound.any():
            return
        typical = median((points[sound] - view.pose.centre) @ view.pose.rotation[:, 2])
        plain = view.pose.centre + typical * view.intrinsics.unproject(pixels) @ view.pose.rotation.T
        features = find_features(view.picture, REFERENCE_FEATURES)
        places, good = view.points(features.pixels)
        if good.sum() < LEAST_FEATURES:
            return
        self._grids.append(np.where(sound[:, None], points, plain))
        self.references.append(Reference(view.pose, features.select(good), places[good]))

    def votes(self, features: Features) -> Array:
        """How much the features of a query speak for each reference, [R]."""
        return self._retrieval.votes(features)


def travelled_px(renderer: MapRenderer, path: Trajectory) -> Array:
    """Image motion [n] from the begin of a path to each of its poses, at the median depth of its first view."""
    first = renderer.render(Pose(path.rotations[0], path.centres[0]))
    seen = first.depth[first.sound]
    depth = median(seen.astype(float)) if len(seen) else 1.0
    turn = np.linalg.norm(log_so3(path.rotations[:-1].swapaxes(1, 2) @ path.rotations[1:]), axis=1)
    move = np.linalg.norm(np.diff(path.centres, axis=0), axis=1)
    return np.asarray(np.r_[0, np.cumsum(renderer.camera.intrinsics.fx * (turn + move / depth))])


def _grid(camera: Camera) -> Array:
    x = (np.arange(GRID[0]) + 0.5) * camera.width / GRID[0]
    y = (np.arange(GRID[1]) + 0.5) * camera.height / GRID[1]
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
