"""A card with a tag of 10 cm in the built-in room."""

import cv2
import numpy as np

from spiked.simulate.room import Card
from spiked.tag_scale import TAG_FAMILIES

SIDE_M = 0.10
"""Of the black square."""
TAG = 7
_CELLS, _BORDER, _TEXELS = 8, 2, 32
"""Cells of the tag and of its white border, and texels of a cell."""


def tag_card() -> Card:
    """The tag 7 of 36h11 with its white border, as laser printers print it."""
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(TAG_FAMILIES["36h11"]), TAG, _CELLS)
    paper = np.kron(np.pad(marker, _BORDER, constant_values=255), np.ones((_TEXELS, _TEXELS))).astype(np.float32) / 255
    return Card(0.06 + 0.79 * paper, SIDE_M * (_CELLS + 2 * _BORDER) / _CELLS)
