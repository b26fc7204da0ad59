"""A calibration board as a scene, and a hand-held camera that looks at it from all sides."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.board import Board
from spiked.sensor import Intrinsics
from spiked.simulate.motion import Harmonics, look_at
from spiked.simulate.view import View

_SQUARE_PX = 48
"""Texels of a square."""
_WHITE, _BLACK, _BEHIND = 0.85, 0.06, 0.35
"""Intensities of white and black paint, and of the wall behind the board."""
_MARGIN = 0.5
"""White border of the board, in squares."""
_SAMPLES = 1200
"""Samples across an image, at least, as a whole number for each pixel."""

Array = NDArray[np.float64]


class BoardScene:
    """A board in front of an even wall, in the plane z = 0, lengths in squares; the camera is at negative z."""

    def __init__(self, board: Board) -> None:
        self.board = board
        margin = round(_MARGIN * _SQUARE_PX)
        paint = board.picture(_SQUARE_PX).astype(np.float32) / 255
        paper = np.pad(_BLACK + (_WHITE - _BLACK) * paint, margin, constant_values=_WHITE)
        self._texture = np.pad(paper, 1, constant_values=_BEHIND)
        origin = -_MARGIN - 1 / _SQUARE_PX
        self._from_texel = np.array(
            [[1 / _SQUARE_PX, 0, origin], [0, 1 / _SQUARE_PX, origin], [0, 0, 1.0]]
        )  # texels, first corner at 0, to squares

    def render(self, intrinsics: Intrinsics, width: int, height: int, rotation: Array, centre: Array) -> View:
        """See `ViewableScene.render`; depth is that of the board's plane."""
        samples = -(-_SAMPLES // width)
        fine = intrinsics.scaled(samples)
        turn = rotation.T
        plane = fine.matrix() @ np.stack([turn[:, 0], turn[:, 1], -turn @ centre], 1)
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's warp counts pixel centres from 0
        mapping = np.linalg.inv(half) @ plane @ self._from_texel @ half
        size = (width * samples, height * samples)
        image = cv2.warpPerspective(
            self._texture, mapping, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=_BEHIND
        )
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        # z of the rays of the pixels: linear in the image
        x = (np.arange(width) + 0.5 - intrinsics.cx) / intrinsics.fx
        y = (np.arange(height) + 0.5 - intrinsics.cy) / intrinsics.fy
        along = rotation[2, 0] * x + (rotation[2, 1] * y + rotation[2, 2])[:, None]
        depth = np.where(along > 1e-6, -centre[2] / np.maximum(along, 1e-6), np.inf)
        return View(np.ascontiguousarray(image[..., None], np.float32), depth.astype(np.float32))


@dataclass(frozen=True)
class AroundBoard:
    """A hand-held camera that sways around a board, tilts, rolls, and goes nearer and farther."""

    board: Board
    distance: float
    """Mean distance, in squares."""
    sway: Harmonics
    """Of the directions of view across and down, roll, logarithm of the distance, and target across and down."""

    @classmethod
    def of(cls, board: Board, intrinsics: Intrinsics, width: int, height: int, frames: int, seed: int) -> "AroundBoard":
        """A path on which the board fills most of an image of that size, seen from every side within `frames`."""
        far = intrinsics.unproject(np.array([[width, height / 2.0], [width / 2.0, height]]))
        half = np.array([board.columns, board.rows]) / 2
        distance = 1.1 * float(np.max(half / np.array([far[0, 0], far[1, 1]])))
        reach = np.array([0.4, 0.4, 0.25, 0.1, 0.05 * board.columns, 0.05 * board.rows])  # rad, rad, rad, -, squares
        periods = (frames / 7, frames / 2)
        speed = 2 * np.pi * reach / np.sqrt(periods[0] * periods[1])
        rng = np.random.default_rng(np.random.SeedSequence([seed, 0xB0A2D]))
        return cls(board, distance, Harmonics.draw(rng, speed, periods, 3))

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        moved = self.sway.at(np.atleast_1d(np.asarray(frames, np.float64)))
        across, down, roll, nearer, right, below = moved.T
        target = np.stack([self.board.columns / 2 + right, self.board.rows / 2 + below, np.zeros(len(moved))], 1)
        direction = np.stack([np.sin(across), np.sin(down) * np.cos(across), -np.cos(across) * np.cos(down)], 1)
        centre = target + (self.distance * np.exp(nearer))[:, None] * direction
        up = np.stack([np.sin(roll), -np.cos(roll), np.zeros(len(roll))], 1)
        return look_at(centre, target, up), centre
