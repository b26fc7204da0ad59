"""The scale of a scene from AprilTags of known size in it.

Tags are looked for in pictures of the scene rendered along the path, so that nothing but the result of a reconstruction
is needed. The square that fits all sightings of a tag best has the size of the tag in the unit of the scene.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, SceneError
from spiked.recon.statistics import evenly
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory

__all__ = [
    "TAG_FAMILIES",
    "FoundTag",
    "Sighting",
    "TagScale",
    "scale_by_sightings",
    "scale_by_tags",
    "sightings",
    "tags_in",
]

Array = NDArray[np.float64]

TAG_FAMILIES = {
    "16h5": cv2.aruco.DICT_APRILTAG_16H5,
    "25h9": cv2.aruco.DICT_APRILTAG_25H9,
    "36h10": cv2.aruco.DICT_APRILTAG_36H10,
    "36h11": cv2.aruco.DICT_APRILTAG_36H11,
}
"""OpenCV's sets of AprilTags by the names of their families."""
VIEWS = 48
"""Views along the path in which tags are looked for."""
LEAST_VIEWS = 4
"""Views that have to show a tag."""
ENLARGED_PX = 1200
"""Width of the pictures, at least: the corners of small tags are found more surely in large ones."""
MOST_ERROR_PX = 2.0
"""Largest distance of a corner from its projection, in pixels of the picture, before its view is left out."""
LEAST_TURN_DEG = 2.0
"""Angle between the lines of sight to a tag that its distance needs, at least."""

_ALONG = np.linspace(0.12, 0.88, 24)
"""Where the edge of a side is looked for, as shares of the side: not at its ends, where two sides blur together."""
_ACROSS_SHARE = 0.06
"""How far across, over the length of the side: half of a cell of the tag."""
_STEPS = 33
"""Samples across."""

_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
"""Corners of a tag of side 1 in the order of OpenCV: top left, top right, bottom right, bottom left; y up."""


@dataclass(frozen=True)
class Sighting:
    """A tag in one picture."""

    tag: int
    """Its number in the family."""
    rotation: Array
    """Of the camera, camera to world, [3, 3]."""
    centre: Array
    """[3]"""
    rays: Array
    """Directions to the corners in the camera, z is 1, [4, 3]; corners in the order of OpenCV."""
    focal_px: float
    """Of the picture: what a difference of rays is in pixels."""


@dataclass(frozen=True)
class FoundTag:
    """A tag in the scene."""

    tag: int
    views: int
    side: float
    """Side of its black square, in the unit of the scene."""
    sigma: float
    """Relative standard deviation of the side."""
    error_px: float
    """Root mean square distance of the corners from their projections, in pixels of the rendered pictures."""
    corners: Array
    """In the scene, [4, 3]."""


@dataclass(frozen=True)
class TagScale:
    """The scale by all tags."""

    metres_per_unit: float
    sigma: float
    """Relative standard deviation."""
    tags: tuple[FoundTag, ...]


def scale_by_tags(
    scene: Scene, path: Trajectory, camera: Camera, side_m: float, family: str = "36h11", views: int = VIEWS
) -> TagScale:
    """The scale of a scene with tags whose black squares have sides of `side_m`.

    Raises ConfigurationError for an unknown family or a length that is not positive, SceneError if no tag is found.
    """
    if not side_m > 0:
        raise ConfigurationError(f"--tag {side_m:g}: the side of the tag's black square has to be positive, in metres")
    return scale_by_sightings(sightings(scene, path, camera, family, views), side_m)


def sightings(
    scene: Scene, path: Trajectory, camera: Camera, family: str = "36h11", views: int = VIEWS
) -> list[Sighting]:
    """All tags in pictures of the scene, rendered without distortion along the path. Raises ConfigurationError."""
    if family not in TAG_FAMILIES:
        raise ConfigurationError(f"no family of AprilTags {family!r}: choose one of {', '.join(TAG_FAMILIES)}")
    found = []
    for picture, optics, rotation, centre in pictures_along(scene, path, camera, views):
        found += tags_in(picture, optics, rotation, centre, family)
    return found


def pictures_along(
    scene: Scene, path: Trajectory, camera: Camera, views: int
) -> Iterator[tuple[NDArray[np.float32], Intrinsics, Array, Array]]:
    """Grey pictures of the scene along the path, white is 1, without distortion, with their optics and poses."""
    larger = max(1, -(-ENLARGED_PX // camera.width))
    pinhole = camera.intrinsics.pinhole
    # Of the camera's own size, then enlarged: the renderer widens splats by a share of a pixel, as when the scene was
    # fitted. In a larger picture all are thinner, and a black square on white is 1 % larger.
    rasteriser = rasteriser_for(Camera(pinhole, camera.width, camera.height))
    for row in evenly(len(path), views):
        rotation, centre = path.rotations[row], path.centres[row]
        image = rasteriser.forward(scene, rotation[None], centre[None]).values
        grey = image if image.ndim == 2 else image.mean(axis=2)
        yield (
            enlarged(grey / max(scene.colour_of_white, 1e-12), larger),
            pinhole.scaled(larger),
            rotation,
            centre,
        )


def enlarged(picture: NDArray[np.float32], times: int) -> NDArray[np.float32]:
    """A picture [H, W] with `times` as many rows and columns, interpolated."""
    if times == 1:
        return picture
    return np.asarray(cv2.resize(picture, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC), np.float32)


def tags_in(
    image: NDArray[np.float32], optics: Intrinsics, rotation: Array, centre: Array, family: str = "36h11"
) -> list[Sighting]:
    """The tags in a picture without distortion, [H, W], white is 1, of a camera at a pose, camera to world."""
    grey = np.ascontiguousarray(image, np.float32)
    corners, numbers, _ = _detector(family).detectMarkers(np.clip(255 * grey, 0, 255).astype(np.uint8))
    found = []
    for pixels, number in zip(corners, () if numbers is None else numbers.ravel(), strict=True):
        # OpenCV counts the centre of the first pixel from 0.
        rays = optics.unproject(_refined(grey, pixels.reshape(4, 2).astype(np.float64)) + 0.5)
        found.append(Sighting(int(number), rotation, centre, rays, optics.fx))
    return found


def scale_by_sightings(seen: list[Sighting], side_m: float) -> TagScale:
    """The scale by tags that were seen, weighed by their certainty. Raises SceneError if none was seen well enough."""
    by_tag: dict[int, list[Sighting]] = defaultdict(list)
    for one in seen:
        by_tag[one.tag].append(one)
    tags = tuple(tag for number in sorted(by_tag) if (tag := _fit(number, by_tag[number])) is not None)
    if not tags:
        most = max((len(views) for views in by_tag.values()), default=0)
        why = f"a tag is in {most} of the pictures only" if most else "no tag is in any picture of the scene"
        raise SceneError(
            f"{why}; {LEAST_VIEWS} views from different sides are needed: move round the tag, nearer, or print a "
            "larger one; or give a known length instead"
        )
    weights = np.array([1 / tag.sigma**2 for tag in tags])
    side = float(np.average([tag.side for tag in tags], weights=weights))
    spread = float(np.sqrt(np.average([(tag.side / side - 1) ** 2 for tag in tags], weights=weights)))
    return TagScale(side_m / side, max(float(weights.sum() ** -0.5), spread / np.sqrt(len(tags))), tags)


def _detector(family: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    parameters.adaptiveThreshWinSizeMax = 53
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(TAG_FAMILIES[family]), parameters)


def _refined(grey: NDArray[np.float32], corners: Array) -> Array:
    """Corners [4, 2] where the lines of the steepest edges meet.

    Corner detectors find the corners of a blurred square too far inside; the place of a straight edge is not moved.
    """
    lines = [_edge(grey, corners[i], corners[(i + 1) % 4]) for i in range(4)]
    found = [np.cross(lines[i - 1], lines[i]) for i in range(4)]
    refined = np.stack([point[:2] / point[2] if abs(point[2]) > 1e-9 else np.full(2, np.inf) for point in found])
    side = float(np.linalg.norm(corners[1] - corners[0]))
    near = np.linalg.norm(refined - corners, axis=1) < max(3.0, 2 * _ACROSS_SHARE * side)
    return np.where(near[:, None], refined, corners)


def _edge(grey: NDArray[np.float32], begin: Array, end: Array) -> Array:
    """The homogeneous line of the edge from dark inside to bright outside, between two corners clockwise."""
    along = end - begin
    length = float(np.linalg.norm(along))
    outside = np.array([along[1], -along[0]]) / length
    offsets = np.linspace(-1, 1, _STEPS) * max(2.0, _ACROSS_SHARE * length)
    points = begin + _ALONG[:, None] * along
    places = (points[:, None] + offsets[:, None] * outside).astype(np.float32)
    profile = cv2.remap(grey, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slope = np.maximum(np.diff(profile, axis=1), 0) ** 2
    middle = (offsets[1:] + offsets[:-1]) / 2
    at = (slope @ middle) / np.maximum(slope.sum(axis=1), 1e-12)
    on = points + at[:, None] * outside
    x, y, px, py = cv2.fitLine(on.astype(np.float32), cv2.DIST_HUBER, 0, 1e-3, 1e-3).ravel().astype(np.float64)
    return np.array([-y, x, y * px - x * py])


def _fit(number: int, views: list[Sighting]) -> FoundTag | None:
    """The square that all sightings of a tag agree with best; None if too few agree, or all from one side."""
    if len(views) < LEAST_VIEWS:
        return None
    start = _square(np.stack([crossing([(one.centre, one.rotation @ one.rays[k]) for one in views]) for k in range(4)]))
    fit = scipy.optimize.least_squares(_errors, start, args=(views,), loss="soft_l1")
    worst = np.abs(_errors(fit.x, views)).reshape(len(views), -1).max(axis=1)
    views = [one for one, error in zip(views, worst, strict=True) if error < MOST_ERROR_PX]
    if len(views) < LEAST_VIEWS or turn_deg([one.centre for one in views], fit.x[3:6]) < LEAST_TURN_DEG:
        return None
    fit = scipy.optimize.least_squares(_errors, fit.x, args=(views,))
    errors = _errors(fit.x, views)
    variance = float(errors @ errors) / max(1, len(errors) - len(fit.x))
    jacobian = np.asarray(fit.jac)
    information = jacobian.T @ jacobian
    # The corners of one view share the error of its pose, so that they count as one observation.
    sigma = float(np.sqrt(4 * variance * np.linalg.inv(information)[6, 6]))
    return FoundTag(
        number,
        len(views),
        float(np.exp(fit.x[6])),
        max(sigma, 1e-6),
        float(np.sqrt(2 * np.mean(errors**2))),
        _corners(fit.x),
    )


def crossing(lines: Sequence[tuple[Array, Array]]) -> Array:
    """The point nearest to lines of sight, each a point and a direction."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for centre, along in lines:
        unit = along / np.linalg.norm(along)
        across = np.eye(3) - np.outer(unit, unit)
        normal += across
        right += across @ centre
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], np.float64)


def _square(points: Array) -> Array:
    """Rotation vector, centre and logarithm of the side of a square about four points [4, 3]."""
    x = points[1] - points[0] + points[2] - points[3]
    y = points[0] - points[3] + points[1] - points[2]
    side = (np.linalg.norm(x) + np.linalg.norm(y)) / 4
    x = x / np.linalg.norm(x)
    y = y - (y @ x) * x
    y = y / np.linalg.norm(y)
    turn = cv2.Rodrigues(np.stack([x, y, np.cross(x, y)], axis=1))[0].ravel()
    return np.concatenate([turn, points.mean(axis=0), [np.log(side)]])


def _corners(square: Array) -> Array:
    rotation = cv2.Rodrigues(square[:3])[0]
    return np.asarray(square[3:6] + np.exp(square[6]) * _CORNERS @ rotation[:, :2].T)


def _errors(square: Array, views: list[Sighting]) -> Array:
    """Projections minus corners, px, [8 n]."""
    corners, found = _corners(square), []
    for one in views:
        inside = (corners - one.centre) @ one.rotation
        ahead = np.maximum(inside[:, 2:], 1e-9)
        found.append(one.focal_px * (inside[:, :2] / ahead - one.rays[:, :2]))
    return np.concatenate(found).ravel()


def turn_deg(centres: Sequence[Array], point: Array) -> float:
    """Largest angle between the directions from which a point is seen."""
    towards = np.stack([point - centre for centre in centres])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(towards @ towards.T, -1, 1)).max()))
