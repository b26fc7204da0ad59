"""Boards of squares and markers (ChArUco) that cameras are calibrated with."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError

__all__ = ["Board"]

MARKER_SHARE = 0.75
"""Side of a marker over that of its square."""
DICTIONARIES = {
    name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_") and name[5].isdigit()
}
"""OpenCV's sets of markers by their names in options, as `4x4_100`."""
PRINTED_SQUARE_PX = 120
"""Pixels of a square of a board to be printed."""


@dataclass(frozen=True)
class Board:
    """A ChArUco board; lengths are in squares."""

    columns: int
    """Squares in a row."""
    rows: int
    dictionary: str = "4x4_100"
    """One of `DICTIONARIES`."""

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 60 and 3 <= self.rows <= 60):
            raise ConfigurationError(f"a board of {self.columns}x{self.rows} squares: both numbers are 3 to 60")
        if self.dictionary not in DICTIONARIES:
            raise ConfigurationError(f"no markers {self.dictionary!r}: choose one of {', '.join(sorted(DICTIONARIES))}")
        markers = self.columns * self.rows // 2
        held = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary]).bytesList.shape[0]
        if markers > held:
            raise ConfigurationError(
                f"a board of {self.columns}x{self.rows} squares has {markers} markers, and {self.dictionary} only "
                f"{held}: choose a larger set"
            )

    @classmethod
    def parse(cls, text: str, dictionary: str) -> "Board":
        """From `COLUMNSxROWS`. Raises ConfigurationError."""
        columns, _, rows = text.lower().partition("x")
        if not (columns.isdigit() and rows.isdigit()):
            raise ConfigurationError(f"--board {text!r}: write the numbers of squares, COLUMNSxROWS, as 9x6")
        return cls(int(columns), int(rows), dictionary)

    @cached_property
    def _native(self) -> cv2.aruco.CharucoBoard:
        markers = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])
        return cv2.aruco.CharucoBoard((self.columns, self.rows), 1.0, MARKER_SHARE, markers)

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """Inner corners [n, 3] in squares, by their numbers."""
        return np.asarray(self._native.getChessboardCorners(), np.float64)

    def picture(self, square_px: int = PRINTED_SQUARE_PX) -> NDArray[np.uint8]:
        """The board, [rows * square_px, columns * square_px], black and white."""
        size = (self.columns * square_px, self.rows * square_px)
        return np.asarray(self._native.generateImage(size, None, 0, 1), np.uint8)

    def find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Numbers [n] of the inner corners in a grey image [H, W], and where they are, [n, 2] px (pixel centres at
        +0.5)."""
        detector = cv2.aruco.CharucoDetector(self._native)
        at, numbers, _, _ = detector.detectBoard(image)
        if numbers is None or at is None:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        return np.asarray(numbers, np.int64).ravel(), np.asarray(at, np.float64).reshape(-1, 2) + 0.5
