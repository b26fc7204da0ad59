"""Draw the pictures of docs/first-session.md: a board with the errors of its corners, and rows the wrong way up.

    .venv/bin/python evaluation/board_pictures.py docs/page

Writes board.webp, residuals.webp and rows.webp. The camera is simulated; of the two seconds of the board only the
frames that the calibration reads are.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.blocks import aligned_window
from spiked.board import Board
from spiked.distortion import Distortion, LensModel
from spiked.lens_calibration import board_views, calibrate_lens
from spiked.sensor import Image, Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.board import AroundBoard, BoardScene

BOARD, WIDTH, HEIGHT, FRAMES = Board(9, 6), 400, 250, 40_000
LENS = Intrinsics(346.0, 347.0, 203.0, 123.0, Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.002, -0.001)))
SHOWN_FRAMES = 32
VIEWS = 14
QUALITY = 90
PAPER = (1100, 700)
WORDS = (("SPIKE", 0.42), ("CAMERA", 0.72))


class Later:
    """A path from some frame on."""

    def __init__(self, path: AroundBoard, first: int) -> None:
        self._path, self._first = path, first

    def poses(self, frames: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `Motion.poses`."""
        return self._path.poses(np.asarray(frames, float) + self._first)


class TwoSeconds:
    """Two seconds of a board, of which only the frames that are read are simulated."""

    path, frames = Path("board.dat"), FRAMES

    def __init__(self) -> None:
        self.sensor = Sensor(WIDTH, HEIGHT, 20_000.0, intrinsics=LENS)
        self._motion = AroundBoard.of(BOARD, LENS, WIDTH, HEIGHT, FRAMES, 0)
        self._scene = BoardScene(BOARD)

    def read(self, first: int, count: int) -> NDArray[np.uint8]:
        """Frames as stored, uint8 [count, frame_bytes]."""
        camera = SimulatedCamera(self.sensor, first, Later(self._motion, first), self._scene, threads=2)
        return camera.next_frames(count)

    def picture(self, first: int) -> Image:
        """Rates [H, W] about a frame, white is 1."""
        spikes = self.read(first, 3 * SHOWN_FRAMES)
        window = aligned_window(spikes, self.sensor, first, first + SHOWN_FRAMES, first + 2 * SHOWN_FRAMES)
        rate = window.rate(fill=True)
        return np.asarray(rate / np.percentile(rate, 99), np.float32)


def writing() -> NDArray[np.uint8]:
    """A sheet of paper with writing on a dark table."""
    sheet = np.full((PAPER[1], PAPER[0]), 60, np.uint8)
    corners = np.array([[140, 90], [980, 130], [1010, 610], [110, 580]])
    cv2.fillPoly(sheet, [corners], 225)
    for text, height in WORDS:
        at = (200, int(height * PAPER[1]))
        cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, 5.2, 30, 16, cv2.LINE_AA)
    return np.asarray(cv2.resize(sheet, (360, 229), interpolation=cv2.INTER_AREA), np.uint8)


def rows() -> NDArray[np.uint8]:
    """The three ways in which the writing can appear, with what each means."""
    upright, space = writing(), 20
    panels = [
        (upright, "right: nothing to state"),
        (upright[::-1], "mirrored: flipped=false"),
        (upright[::-1, ::-1], "not mirrored: camera upside down"),
    ]
    canvas = np.full((upright.shape[0] + 40, 3 * upright.shape[1] + 2 * space), 255, np.uint8)
    for number, (picture, text) in enumerate(panels):
        x = number * (upright.shape[1] + space)
        canvas[: upright.shape[0], x : x + upright.shape[1]] = picture
        at = (x + 4, upright.shape[0] + 27)
        cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 20, 1, cv2.LINE_AA)
    return canvas


def write(path: Path, picture: NDArray[np.uint8]) -> None:
    """As WebP."""
    path.write_bytes(cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])[1].tobytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    write(folder / "rows.webp", rows())
    board = TwoSeconds()
    shots = [np.clip(255 * board.picture(first), 0, 255).astype(np.uint8) for first in (4_000, 17_000, 31_000)]
    write(folder / "board.webp", np.hstack([np.pad(shot, ((0, 0), (0, 8)), constant_values=255) for shot in shots]))
    found = calibrate_lens(board_views(board, BOARD, views=VIEWS), BOARD, WIDTH, HEIGHT)  # type: ignore[arg-type]
    write(folder / "residuals.webp", found.picture(WIDTH, HEIGHT))
    print(f"{found.rms_px:.3f} px RMS, {len(found.pixels)} corners")


if __name__ == "__main__":
    main()
