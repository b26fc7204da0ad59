"""How two maps lie to each other, whether they agree where they overlap, and which splats of each are kept."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.pose import Array
from spiked.recon.localisation.map_index import NOMINAL_WIDTH_PX, MapIndex, travelled_px
from spiked.recon.localisation.map_views import MapRenderer
from spiked.recon.mapping.replay import Replay
from spiked.recon.merging.coverage import Agreement, Shown, compare, fineness
from spiked.recon.merging.known_map import KnownMap, coloured
from spiked.recon.merging.registration import MapPlace, NotOnePlaceError, Registration, register
from spiked.recon.odometry.sparse_map import Pose
from spiked.recon.statistics import evenly, median
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory

SPACING_PX = 25.0
"""Image motion at a width of `NOMINAL_WIDTH_PX` between the places from which a map is looked at."""
PLACES, PLACES_PIXELS = (12, 160), 2e7
"""Least and largest number of these places, and the pixels of all of them, which bound the memory: 20 bytes a pixel."""
FINENESS_VIEWS = 50
"""Views, at most, by which it is known which surfaces a map shows."""
FINER = 1.25
"""The second map's splats replace the first map's where it shows the surface at so many times as many pixels; at the
inverse of it if it has colours, and the first is grey."""
ALIKE, DIFFERENT = 0.5, 0.25
"""Correlation of details of both maps in a view above which they agree there, and below which they differ."""
EXACT = 0.9
"""The same above which the joint map is trained on all of a view of the second map: below it, pictures of a surface
that both show are slightly apart, and would be blurred into one."""
SAME_DEPTHS = 0.5
"""Share of the common pixels with equal depths that a view needs to agree, and below whose half it differs."""
LEAST_ALIKE = 3
"""Views of the second map in which the first has to look the same."""
NARROWER = 1.1
"""Tangent of the second camera's field of view over that of the first above which only what both see is compared."""
DIFFERENT_SHARE = 0.5
"""Views that differ, over those that agree, above which the maps do not show the same place."""


_Any = TypeVar("_Any")


@dataclass(frozen=True)
class Joint:
    """Two maps in the first map's frame of reference."""

    first: KnownMap
    second: KnownMap
    """Moved there, its radiance as the first map's."""
    registration: Registration
    brightness: float
    """Radiance of the first map over that of the second."""
    alike: int
    """Views of the second map that look the same in the first."""
    different: int
    """Views that look different."""
    first_views: Sequence[Shown]
    """The first map along its way."""
    second_views: Sequence[Shown]
    """The second map along its way."""
    exact: Sequence[bool]
    """Of the second views: the first map shows the same there, as far as it shows anything."""

    def kept(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Splats of each map, [N1] and [N2], that show surfaces which the other does not show more finely."""
        first, second = (one.scene.means.astype(np.float64) for one in (self.first, self.second))
        return ~self._finer_in_second(first), self._finer_in_second(second)

    def splats(self, kept: tuple[NDArray[np.bool_], NDArray[np.bool_]]) -> Scene:
        """One scene of the splats that are kept of each map, in colour if one of them is."""
        first, second = self.first.scene.select(kept[0]), self.second.scene.select(kept[1])
        if first.colours.shape[1] != second.colours.shape[1]:
            first, second = coloured(first), coloured(second)
        return first.join(second)

    def _finer_in_second(self, points: Array) -> NDArray[np.bool_]:
        """Which points [n, 3] are to be shown by the second map."""
        first, second = (fineness(some(views), points).max(1) for views in (self.first_views, self.second_views))
        only_second_has_colours = self.first.scene.colours.shape[1] < self.second.scene.colours.shape[1]
        return np.asarray(second > (1 / FINER if only_second_has_colours else FINER) * first)

    def replays(self, kept: tuple[NDArray[np.bool_], NDArray[np.bool_]]) -> list[Replay]:
        """What both maps show along their ways; the second where the first does not show it otherwise."""
        scene, counts = self.splats(kept), [int(one.sum()) for one in kept]
        owners = np.repeat(np.array([0, 1], np.float32), counts)[:, None]
        marked = replace(scene, colours=np.ascontiguousarray(owners))
        second = []
        for view, exact in zip(self.second_views, self.exact, strict=True):
            own = view.replay.render(marked).values > 0.5
            second.append(view.replay if exact else view.replay.only(own))
        return [*(view.replay for view in self.first_views), *second]


def places(known: KnownMap, threads: int | None = None) -> list[MapPlace]:
    """Places along the way of a map, in the order of time, evenly spread by image motion."""
    renderer, path = MapRenderer(known.scene, known.camera, threads), known.trajectory
    travelled = travelled_px(renderer, path)
    most = int(np.clip(PLACES_PIXELS / (known.camera.width * known.camera.height), *PLACES))
    count = int(np.clip(travelled[-1] * NOMINAL_WIDTH_PX / known.camera.width / SPACING_PX, PLACES[0], most))
    rows = np.unique(np.searchsorted(travelled, np.linspace(0, travelled[-1], count)))
    poses = [(float(path.times_s[row]), Pose(path.rotations[row], path.centres[row])) for row in rows]
    return [MapPlace(time, renderer.render(pose)) for time, pose in poses]


def join(first: KnownMap, second: KnownMap, threads: int | None = None) -> Joint:
    """Bring the second map into the frame of reference of the first.

    Raises NotOnePlaceError, and SceneError for a map that is empty or has no texture.
    """
    if len(second.scene) == 0 or len(second.trajectory) == 0:
        raise SceneError("the second map is empty: reconstruct a recording first")
    seen_by = replace(second, camera=common_camera(first.camera, second.camera))
    index = MapIndex(first.scene, first.trajectory, seen_by.camera, threads)
    own = places(seen_by, threads)
    found = register(index, own)
    chosen = some(own)
    before = _shown(second, [place.view.pose for place in chosen], threads)
    times = np.array([place.time for place in chosen])
    weights = fineness(before, second.scene.means.astype(np.float64))
    poses = _poses(found.warp.path(_path(own)))

    def moved(brightness: float) -> KnownMap:
        scene = found.warp.scene(second.scene, weights, times, brightness)
        return KnownMap(scene, found.warp.path(second.trajectory), second.camera)

    seen = _compare(first, replace(moved(1.0), camera=seen_by.camera), poses, threads)
    compared = [one for one in seen if one is not None]
    alike = [one for one in compared if one.correlation > ALIKE and one.same > SAME_DEPTHS]
    different = sum(one.correlation < DIFFERENT or one.same < 0.5 * SAME_DEPTHS for one in compared)
    if len(alike) < LEAST_ALIKE or different > DIFFERENT_SHARE * len(alike):
        raise NotOnePlaceError(
            f"these two do not show the same place: {len(found.sightings)} views of the second map agree on how the "
            f"maps lie to each other, but in {different} views the maps look different there, and the same in "
            f"{len(alike)}"
        )
    brightness = median(np.array([one.brightness for one in alike]))
    there = moved(brightness)
    views = _shown(first, [place.view.pose for place in places(first, threads)], threads), _shown(there, poses, threads)
    exact = [one is not None and one.correlation > EXACT for one in seen]
    return Joint(first, there, found, brightness, len(alike), different, *views, exact)


def common_camera(first: Camera, second: Camera) -> Camera:
    """The second camera, cropped where it sees beyond the field of view of the first: a map has nothing there."""
    a, b = _extent(first), _extent(second)
    if (b <= NARROWER * a).all():
        return second
    k = second.intrinsics
    left, up, right, down = np.minimum(a, b) * np.array([k.fx, k.fy, k.fx, k.fy])
    width, height = max(1, round(left + right)), max(1, round(up + down))
    return replace(second, intrinsics=Intrinsics(k.fx, k.fy, left, up), width=width, height=height)


def _extent(camera: Camera) -> Array:
    """Tangents of the field of view [4]: to the left, up, to the right, down."""
    k = camera.intrinsics
    return np.array([k.cx / k.fx, k.cy / k.fy, (camera.width - k.cx) / k.fx, (camera.height - k.cy) / k.fy])


def some(views: Sequence[_Any]) -> list[_Any]:
    """At most `FINENESS_VIEWS` views, evenly spread."""
    return [views[row] for row in evenly(len(views), FINENESS_VIEWS)]


def _path(own: list[MapPlace]) -> Trajectory:
    poses = [place.view.pose for place in own]
    return Trajectory(
        np.array([place.time for place in own]),
        np.stack([pose.rotation for pose in poses]),
        np.stack([pose.centre for pose in poses]),
    )


def _poses(path: Trajectory) -> list[Pose]:
    return [Pose(rotation, centre) for rotation, centre in zip(path.rotations, path.centres, strict=True)]


def _shown(known: KnownMap, poses: list[Pose], threads: int | None) -> list[Shown]:
    rasteriser = rasteriser_for(known.camera, threads)
    return [Shown.of(rasteriser, known.camera, known.scene, pose) for pose in poses]


def _compare(first: KnownMap, second: KnownMap, poses: list[Pose], threads: int | None) -> list[Agreement | None]:
    """Two maps compared at poses of the second; None where they have little in common."""
    there = _shown(replace(first, camera=second.camera), poses, threads)
    return [compare(a, b) for a, b in zip(there, _shown(second, poses, threads), strict=True)]
