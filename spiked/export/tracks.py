"""Points of the scene and where the pictures show them: corners, followed from picture to picture and triangulated.

A corner's depth in the scene says where other pictures show it; Lucas and Kanade's method finds it there. What is
exported is therefore measured in the pictures and not projected from the scene.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.export.pictures import KeyPicture
from spiked.export.surface import agrees
from spiked.export.views import Doubles
from spiked.sensor import Intrinsics

__all__ = ["Tracks", "find_tracks"]

CORNERS = 1000
"""Corners of a picture, at most."""
QUALITY, APART_PX = 0.01, 6.0
"""Corner quality relative to the best (`cv2.goodFeaturesToTrack`), and distance between corners."""
WINDOW_PX = 15
"""Side of the patch that is followed."""
SEARCH_PX = 3.0
"""Distance of a corner from where the scene shows it, at most."""
RETURN_PX = 0.3
"""Distance between a corner and itself, followed to another picture and back, at most."""
FOLLOWED = 12
"""Other pictures that a corner is followed to, at most: the nearest."""
LEAST_VIEWS = 3
"""Pictures of a point, at least."""
OUTLIER_PX = 1.5
"""Reprojection error of an observation, at most."""


@dataclass(frozen=True)
class Tracks:
    """n points in m pictures."""

    points: Doubles
    """[n, 3]."""
    colours: NDArray[np.uint8]
    """RGB, [n, 3]."""
    pixels: Doubles
    """[n, m, 2]; NaN where a picture does not show a point."""
    errors: Doubles
    """Reprojection errors in pixels, [n, m]; NaN as `pixels`."""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which pictures show which points, [n, m]."""
        return np.isfinite(self.errors)

    @property
    def median_error_px(self) -> float:
        """Median reprojection error of the observations; NaN without any."""
        return float(np.median(self.errors[self.seen])) if self.seen.any() else float("nan")


def find_tracks(pictures: Sequence[KeyPicture]) -> Tracks:
    """The points that at least three pictures show."""
    grey = [picture.grey() for picture in pictures]
    pixels = [np.empty((0, len(pictures), 2))]
    colours = [np.empty((0, 3), np.uint8)]
    for number in range(len(pictures)):
        known = np.concatenate([part[:, number] for part in pixels])
        corners = _corners(pictures[number], grey[number], known[np.isfinite(known[:, 0])])
        if len(corners):
            pixels.append(_followed(pictures, grey, number, corners))
            colours.append(_colours(pictures[number], corners))
    return _triangulated(pictures, np.concatenate(pixels), np.concatenate(colours))


def _corners(picture: KeyPicture, grey: NDArray[np.uint8], known: Doubles) -> Doubles:
    """Corners [n, 2] with a depth, away from known ones."""
    mask = (picture.view.normals() != 0).any(-1).astype(np.uint8)
    for x, y in known:
        cv2.circle(mask, (int(x), int(y)), int(APART_PX), 0, -1)
    found = cv2.goodFeaturesToTrack(grey, CORNERS, QUALITY, APART_PX, mask=mask)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + 0.5


def _followed(
    pictures: Sequence[KeyPicture], grey: Sequence[NDArray[np.uint8]], number: int, corners: Doubles
) -> Doubles:
    """Where the pictures show the corners of one of them, [n, m, 2]."""
    view = pictures[number].view
    found = np.full((len(corners), len(pictures), 2), np.nan)
    found[:, number] = corners
    rays = view.camera.intrinsics.unproject(corners)
    points = (rays * view.sampled_depth(corners)[:, None]) @ view.rotation.T + view.centre
    near = sorted(range(len(pictures)), key=lambda other: abs(other - number))[1 : FOLLOWED + 1]
    for other in near:
        rows = np.flatnonzero(agrees(pictures[other].view, points))
        if not len(rows):
            continue
        there = pictures[other].view
        expected = there.camera.intrinsics.project(there.in_camera(points[rows]))
        at, good = _flow(grey[number], grey[other], corners[rows], expected)
        back, returned = _flow(grey[other], grey[number], at, corners[rows])
        good &= returned & (np.linalg.norm(back - corners[rows], axis=1) < RETURN_PX)
        good &= np.linalg.norm(at - expected, axis=1) < SEARCH_PX
        good &= ((at >= 0) & (at <= grey[other].shape[::-1])).all(axis=1)  # the flow runs over the border
        found[rows[good], other] = at[good]
    return found


def _flow(
    one: NDArray[np.uint8], other: NDArray[np.uint8], at: Doubles, expected: Doubles
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Where a picture shows what another shows `at`, [n, 2], and whether it was found, [n]."""
    begin, guess = ((pixels - 0.5).astype(np.float32).reshape(-1, 1, 2) for pixels in (at, expected))
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        one, other, begin, guess.copy(), winSize=(WINDOW_PX, WINDOW_PX), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    return found.reshape(-1, 2).astype(np.float64) + 0.5, status.reshape(-1) == 1


def _colours(picture: KeyPicture, corners: Doubles) -> NDArray[np.uint8]:
    x, y = corners.astype(int).T
    found = picture.pixels[y, x]
    return np.ascontiguousarray(np.broadcast_to(found.reshape(len(corners), -1), (len(corners), 3)))


def _triangulated(pictures: Sequence[KeyPicture], pixels: Doubles, colours: NDArray[np.uint8]) -> Tracks:
    """The points, without observations that do not fit and points that too few pictures show."""
    points = np.empty((0, 3))
    errors = np.empty(pixels.shape[:2])
    for _ in range(2):
        keep = np.isfinite(pixels[..., 0]).sum(1) >= LEAST_VIEWS
        pixels, colours = pixels[keep], colours[keep]
        points = _refined(pictures, pixels, _nearest_to_rays(pictures, pixels))
        errors = np.linalg.norm(_projected(pictures, points) - pixels, axis=-1)
        pixels = np.where((errors < OUTLIER_PX)[..., None], pixels, np.nan)
    errors = np.where(np.isfinite(pixels[..., 0]), errors, np.nan)
    keep = np.isfinite(errors).sum(1) >= LEAST_VIEWS
    return Tracks(points[keep], colours[keep], pixels[keep], errors[keep])


def _nearest_to_rays(pictures: Sequence[KeyPicture], pixels: Doubles) -> Doubles:
    """Points [n, 3] with the least squared distance from the rays of their pixels."""
    normal, right = np.zeros((len(pixels), 3, 3)), np.zeros((len(pixels), 3))
    for number, picture in enumerate(pictures):
        rows = np.flatnonzero(np.isfinite(pixels[:, number, 0]))
        ray = _optics(picture).unproject(pixels[rows, number]) @ picture.view.rotation.T
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        normal[rows] += across
        right[rows] += across @ picture.view.centre
    normal += 1e-9 * np.eye(3)
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _refined(pictures: Sequence[KeyPicture], pixels: Doubles, points: Doubles) -> Doubles:
    """Three Gauss-Newton steps towards the least reprojection error, with Huber's weights at 1 px."""
    for _ in range(3):
        normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for number, picture in enumerate(pictures):
            rows = np.flatnonzero(np.isfinite(pixels[:, number, 0]))
            local = picture.view.in_camera(points[rows])
            z = np.maximum(local[:, 2], 1e-6)
            slope = local[:, :2] / z[:, None]
            by_point = np.zeros((len(rows), 2, 3))
            by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
            by_point[:, :, 2] = -slope / z[:, None]
            jacobian = _optics(picture).by_slope(slope) @ by_point @ picture.view.rotation.T
            off = pixels[rows, number] - _optics(picture).project(local)
            weight = 1 / np.maximum(np.linalg.norm(off, axis=1), 1.0)
            weighted = jacobian.swapaxes(1, 2) * weight[:, None, None]
            normal[rows] += weighted @ jacobian
            right[rows] += (weighted @ off[..., None])[..., 0]
        damping = 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
        points = points + np.linalg.solve(normal + damping * np.eye(3), right[..., None])[..., 0]
    return points


def _projected(pictures: Sequence[KeyPicture], points: Doubles) -> Doubles:
    """Pixels [n, m, 2]."""
    return np.stack([_optics(one).project(one.view.in_camera(points)) for one in pictures], 1)


def _optics(picture: KeyPicture) -> Intrinsics:
    return picture.view.camera.intrinsics
