"""Cards with a tag of 10 cm or a board of 3 cm squares in the built-in room."""

import cv2
import numpy as np

from spiked.board import Board
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.simulate import Room
from spiked.simulate.motion import hand_shake
from spiked.simulate.room import Card
from spiked.tag_scale import TAG_FAMILIES
from spiked.trajectory import Trajectory

SIDE_M = 0.10
"""Of the black square."""
TAG = 7
BOARD = Board(7, 5)
SQUARE_M = 0.03
_CELLS, _BORDER, _TEXELS = 8, 2, 32
"""Cells of the tag and of its white border, and texels of a cell."""


def tag_card() -> Card:
    """The tag 7 of 36h11 with its white border, as laser printers print it."""
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(TAG_FAMILIES["36h11"]), TAG, _CELLS)
    paper = np.kron(np.pad(marker, _BORDER, constant_values=255), np.ones((_TEXELS, _TEXELS))).astype(np.float32) / 255
    return Card(0.06 + 0.79 * paper, SIDE_M * (_CELLS + 2 * _BORDER) / _CELLS)


def board_card() -> Card:
    """The board with a white border of half a square."""
    paper = np.pad(BOARD.picture(32), 16, constant_values=255).astype(np.float32) / 255
    return Card(0.06 + 0.79 * paper, SQUARE_M * (BOARD.columns + 1))


def card_scene(card: Card) -> tuple[Scene, Trajectory, Camera]:
    """The room with a card, in metres, as a splat for each pixel of a view; a path and a camera that see the card."""
    optics, size = Intrinsics.from_fov(400, 248, 60.0), (400, 248)
    room = Room(seed=3, card=card)
    frames = np.arange(0.0, 2000.0, 20.0)
    rotations, centres = hand_shake(room.stage(optics, flow_px=0.06, parallax=0.06), 3).poses(frames)
    rotation, centre = rotations[50], centres[50]
    view = room.render(optics, *size, rotation, centre)
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    depth = view.depth.reshape(-1, 1)
    means = centre + (optics.unproject(np.stack([x, y], -1).reshape(-1, 2)) * depth) @ rotation.T
    scene = Scene(
        means.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
        np.log(np.repeat(0.3 * depth / optics.fx, 3, axis=1)).astype(np.float32),
        np.full(len(means), 4, np.float32),
        np.ascontiguousarray(view.intensity.reshape(-1, 1), np.float32),
        white=1.0,
    )
    return scene, Trajectory(frames / 20_000, rotations, centres), Camera(optics, *size)
