"""The scale of a scene from a ChArUco board of known size in it, found in pictures that are rendered along the path."""

from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from spiked.board import Board
from spiked.errors import ConfigurationError, SceneError
from spiked.evaluate import umeyama
from spiked.render import Camera
from spiked.scene import Scene
from spiked.tag_scale import LEAST_TURN_DEG, LEAST_VIEWS, MOST_ERROR_PX, VIEWS, crossing, pictures_along, turn_deg
from spiked.trajectory import Trajectory

__all__ = ["BoardScale", "BoardSighting", "board_sightings", "scale_by_board", "scale_by_board_sightings"]

Array = NDArray[np.float64]

LEAST_CORNERS = 6
"""Corners that a picture has to show."""


@dataclass(frozen=True)
class BoardSighting:
    """A board in one picture."""

    numbers: NDArray[np.int64]
    """Of the corners, [n]."""
    rays: Array
    """Directions to them in the camera, z is 1, [n, 3]."""
    rotation: Array
    """Of the camera, camera to world, [3, 3]."""
    centre: Array
    """[3]"""
    focal_px: float
    """Of the picture: what a difference of rays is in pixels."""


@dataclass(frozen=True)
class BoardScale:
    """The scale by a board."""

    metres_per_unit: float
    sigma: float
    """Relative standard deviation."""
    square: float
    """Side of a square, in the unit of the scene."""
    views: int
    corners: int
    """Of the board, that were used."""
    error_px: float
    """Root mean square distance of the corners from their projections, in pixels of the pictures."""


def scale_by_board(
    scene: Scene, path: Trajectory, camera: Camera, board: Board, square_m: float, views: int = VIEWS
) -> BoardScale:
    """The scale of a scene with a board whose squares have sides of `square_m`.

    Raises ConfigurationError for a length that is not positive, SceneError if the board is not found.
    """
    if not square_m > 0:
        raise ConfigurationError(f"--square {square_m:g}: the side of a square has to be positive, in metres")
    return scale_by_board_sightings(board_sightings(scene, path, camera, board, views), board, square_m)


def board_sightings(
    scene: Scene, path: Trajectory, camera: Camera, board: Board, views: int = VIEWS
) -> list[BoardSighting]:
    """The board in pictures of the scene along the path."""
    found = []
    for picture, optics, rotation, centre in pictures_along(scene, path, camera, views):
        numbers, at = board.find(np.clip(255 * picture, 0, 255).astype(np.uint8))
        if len(numbers) >= LEAST_CORNERS:
            found.append(BoardSighting(numbers, optics.unproject(at), rotation, centre, optics.fx))
    return found


def scale_by_board_sightings(seen: list[BoardSighting], board: Board, square_m: float) -> BoardScale:
    """The scale by the board that all sightings agree with best. Raises SceneError if there are too few."""
    start = _start(seen, board)
    if start is None:
        raise SceneError(
            f"the board is in {len(seen)} of the pictures; {LEAST_VIEWS} from different sides are needed: move round "
            "it, nearer, or print a larger one; or give a known length instead"
        )
    fit = scipy.optimize.least_squares(_errors, start, args=(seen, board), loss="soft_l1")
    seen = [one for one in seen if np.abs(_errors(fit.x, [one], board)).max() < MOST_ERROR_PX]
    if len(seen) < LEAST_VIEWS or turn_deg([one.centre for one in seen], fit.x[3:6]) < LEAST_TURN_DEG:
        raise SceneError(f"{len(seen)} views of the board agree, or all from one side: move round the board")
    fit = scipy.optimize.least_squares(_errors, fit.x, args=(seen, board))
    errors = _errors(fit.x, seen, board)
    variance = float(errors @ errors) / max(1, len(errors) - len(fit.x))
    jacobian = np.asarray(fit.jac)
    # The corners of one view share the error of its pose, so that they count as one observation.
    shared = len(errors) / 2 / len(seen)
    sigma = float(np.sqrt(shared * variance * np.linalg.inv(jacobian.T @ jacobian)[6, 6]))
    square = float(np.exp(fit.x[6]))
    corners = len(np.unique(np.concatenate([one.numbers for one in seen])))
    error_px = float(np.sqrt(2 * np.mean(errors**2)))
    return BoardScale(square_m / square, max(sigma, 1e-6), square, len(seen), corners, error_px)


def _start(seen: list[BoardSighting], board: Board) -> Array | None:
    """Rotation vector, centre and logarithm of the square of the board by triangulated corners."""
    rays: dict[int, list[tuple[Array, Array]]] = {}
    for one in seen:
        for number, ray in zip(one.numbers.tolist(), one.rays @ one.rotation.T, strict=True):
            rays.setdefault(number, []).append((one.centre, ray))
    known = {number: crossing(lines) for number, lines in rays.items() if len(lines) >= LEAST_VIEWS}
    if len(known) < LEAST_CORNERS:
        return None
    numbers = list(known)
    similar = umeyama(source=board.corners[numbers], target=np.stack([known[number] for number in numbers]))
    turn = cv2.Rodrigues(similar.rotation)[0].ravel()
    return np.concatenate([turn, similar.translation, [np.log(similar.scale)]])


def _errors(placed: Array, seen: list[BoardSighting], board: Board) -> Array:
    """Projections minus corners, px."""
    corners = placed[3:6] + np.exp(placed[6]) * board.corners @ cv2.Rodrigues(placed[:3])[0].T
    found = []
    for one in seen:
        inside = (corners[one.numbers] - one.centre) @ one.rotation
        ahead = np.maximum(inside[:, 2:], 1e-9)
        found.append(one.focal_px * (inside[:, :2] / ahead - one.rays[:, :2]))
    return np.concatenate(found).ravel()
