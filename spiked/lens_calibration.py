"""Intrinsics and distortion of a camera from a recording of a ChArUco board.

(Z. Zhang, "A flexible new technique for camera calibration", PAMI 2000, as OpenCV has it.)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.board import Board
from spiked.camera import Pinhole
from spiked.distortion import Distortion, LensModel
from spiked.errors import CalibrationError, ConfigurationError
from spiked.rates import white_of
from spiked.recon.frontend.windowing import luminance
from spiked.recon.statistics import evenly
from spiked.recording import Recording
from spiked.sensor import Intrinsics, Sensor

__all__ = ["BoardView", "LensCalibration", "board_views", "calibrate_lens"]

Array = NDArray[np.float64]

VIEWS, WINDOW_FRAMES, EDGE_FRAMES = 80, 16, 48
"""Views of the board, evenly spread over the recording; frames of each; frames on either side that are searched for the
spikes that bound it."""
LEAST_CORNERS, LEAST_VIEWS = 8, 8
"""Corners that a view needs, and views that a calibration needs."""
LEAST_COVER = 0.4
"""Share of the image, in cells of an eighth of its sides, in which corners should have been seen."""
NEWTON_STEPS, NEWTON_TOLERANCE = 20, 1e-6
"""Most steps of a fit, and the relative gain of a step that ends it."""
OUTLIER_DEVIATIONS, ROUNDS = 4.0, 4
"""Corners with larger errors are left out, and the fit repeated, at most so often."""
PICTURE_PX, TEXT_PX, ARROW_SCALE = 1000, 60, 150
"""Width of the picture of errors, about; height of its text; pixels of an arrow for an error of one pixel."""
STEP = 1e-6
"""Step of numeric derivatives, relative to a parameter of size 1."""


@dataclass(frozen=True)
class BoardView:
    """The board's corners in one image."""

    frame: float
    """Middle of the image in frames."""
    numbers: NDArray[np.int64]
    """[n]"""
    pixels: Array
    """[n, 2]"""


@dataclass(frozen=True)
class LensCalibration:
    """Fitted intrinsics with their standard deviations."""

    intrinsics: Intrinsics
    sigmas: dict[str, float]
    """By name: fx, fy, cx, cy in pixels, and the coefficients."""
    rms_px: float
    """Root mean square distance of corners from their projections."""
    views: int
    cover: float
    """Share of the image in which corners were seen, see `LEAST_COVER`."""
    pixels: Array
    """[n, 2] of all corners used."""
    errors: Array
    """[n, 2] px: projections minus corners."""
    rejected: int
    """Corners left out as outliers."""

    def warnings(self) -> list[str]:
        """What makes the result less sure than its deviations say."""
        if self.cover >= LEAST_COVER:
            return []
        return [f"corners were seen in {self.cover:.0%} of the image only: move the board into its corners, too"]

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """The errors of the corners as arrows in an image of the sensor's size, enlarged; [H, W, 3], BGR."""
        scale = max(1, round(PICTURE_PX / width))
        canvas = np.full((height * scale + TEXT_PX, width * scale, 3), 255, np.uint8)
        cv2.rectangle(canvas, (0, 0), (width * scale - 1, height * scale - 1), (160, 160, 160))
        for at, error in zip(self.pixels, self.errors, strict=True):
            x, y = (scale * at).astype(int).tolist()
            end = (scale * at + ARROW_SCALE * error).astype(int).tolist()
            cv2.circle(canvas, (x, y), 2, (200, 160, 60), -1, cv2.LINE_AA)
            cv2.line(canvas, (x, y), end, (40, 40, 200), 1, cv2.LINE_AA)
        k = self.intrinsics
        lines = [
            f"{len(self.pixels)} corners in {self.views} images, RMS {self.rms_px:.3f} px, shown x {ARROW_SCALE}",
            f"fx {k.fx:.2f}  fy {k.fy:.2f}  cx {k.cx:.2f}  cy {k.cy:.2f}   {k.distortion}",
        ]
        for number, text in enumerate(lines):
            at = (8, height * scale + 20 + 22 * number)
            cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA)
        return canvas

    def report(self) -> dict[str, object]:
        """Ready for JSON; `intrinsics` as in a sidecar."""
        optics = Pinhole.of(self.intrinsics)
        return {
            "intrinsics": None if optics is None else optics.model_dump(mode="json"),
            "sigmas": {name: round(value, 7) for name, value in self.sigmas.items()},
            "reprojection_px": round(self.rms_px, 5),
            "images": self.views,
            "corners": len(self.pixels),
            "rejected": self.rejected,
            "cover": round(self.cover, 3),
        }


def board_views(
    recording: Recording,
    board: Board,
    views: int = VIEWS,
    window_frames: int = WINDOW_FRAMES,
    progress: Callable[[float], None] = lambda share: None,
) -> list[BoardView]:
    """Corners of the board in images that are spread over a recording; images with few of them are left out."""
    sensor, found = recording.sensor, []
    if recording.frames < window_frames:
        raise CalibrationError(f"{recording.path} has {recording.frames} frames: an image needs {window_frames}")
    for done, begin in enumerate(evenly(recording.frames - window_frames + 1, views)):
        first, stop = recording.unbroken(begin)
        if begin + window_frames > stop:
            continue  # frames were lost within: the board has moved meanwhile
        low, high = max(begin - EDGE_FRAMES, first), min(begin + window_frames + EDGE_FRAMES, stop)
        window = aligned_window(recording.read(low, high - low), sensor, low, begin, begin + window_frames)
        numbers, pixels = board.find(_picture(window.rate(fill=True), sensor))
        if len(numbers) >= LEAST_CORNERS:
            found.append(BoardView(begin + 0.5 * window_frames, numbers, pixels))
        progress((done + 1) / views)
    return found


def _picture(rate: NDArray[np.float32], sensor: Sensor) -> NDArray[np.uint8]:
    grey = luminance(rate, sensor.mosaic)
    return np.asarray(np.round(255 * np.sqrt(np.clip(grey / white_of(grey), 0, 1))), np.uint8)


def calibrate_lens(
    views: Sequence[BoardView], board: Board, width: int, height: int, model: LensModel | None = None
) -> LensCalibration:
    """Intrinsics and distortion from views of a board.

    Without a `model` all are tried, OpenCV's with and without k3 too, and that of the least description length wins: a
    coefficient has to lower the error by more than noise. Raises CalibrationError for too few views or a failed fit.
    """
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(
            f"the board was found in {len(views)} images, and {LEAST_VIEWS} are needed: record it sharp, evenly lit, "
            f"filling most of the image, and check that it has {board.columns}x{board.rows} squares and markers of "
            f"{board.dictionary}"
        )
    fits = []
    for kind, free in ((LensModel.OPENCV, 4), (LensModel.OPENCV, 5), (LensModel.FISHEYE, 4)):
        if model in (None, kind):
            try:
                fits.append(_robust(views, board, width, height, kind, free))
            except (cv2.error, ConfigurationError, np.linalg.LinAlgError):
                continue  # this model does not fit the lens
    if not fits:
        raise CalibrationError("no lens explains the corners: is the board flat, and are its squares square?")
    return min(fits, key=lambda fit: fit[0])[1]


def _robust(
    views: Sequence[BoardView], board: Board, width: int, height: int, kind: LensModel, free: int
) -> tuple[float, LensCalibration]:
    """A fit without outliers, and its description length: n log(mean square) + parameters log(n)."""
    total = sum(len(view.numbers) for view in views)
    k, poses, errors = _fitted(views, board, width, height, kind, free)
    for _ in range(ROUNDS):
        size = np.concatenate([np.linalg.norm(error, axis=1) for error in errors])
        limit = OUTLIER_DEVIATIONS * float(np.sqrt(np.mean(size**2) / 2))
        kept = [np.linalg.norm(error, axis=1) <= limit for error in errors]
        if all(good.all() for good in kept):
            break
        views = [
            replace(view, numbers=view.numbers[good], pixels=view.pixels[good])
            for view, good in zip(views, kept, strict=True)
            if good.sum() >= LEAST_CORNERS
        ]
        k, poses, errors = _fitted(views, board, width, height, kind, free)
    every, pixels = np.concatenate(errors), np.concatenate([view.pixels for view in views])
    count = len(every)
    sigmas = _sigmas(k, poses, views, board, free, float(np.sqrt(np.mean(every**2))))
    cells = np.unique((pixels * [8 / width, 8 / height]).astype(int), axis=0)
    mean_square = float(np.mean(every**2))
    cost = 2 * count * np.log(mean_square) + (4 + free + 6 * len(views)) * np.log(2 * count)
    # Fits of fewer corners are compared by what one corner costs.
    fit = LensCalibration(
        k, sigmas, float(np.sqrt(2 * mean_square)), len(views), len(cells) / 64, pixels, every, total - count
    )
    return cost / count, fit


Pose = tuple[Array, Array]
"""Rotation vector [3] and translation [3], board to camera."""


def _fitted(
    views: Sequence[BoardView], board: Board, width: int, height: int, kind: LensModel, free: int
) -> tuple[Intrinsics, list[Pose], list[Array]]:
    """A fit with its errors [n, 2] of each view."""
    k, poses = _fit(views, board, width, height, kind, free)
    return k, poses, [_errors(k, pose, view, board) for pose, view in zip(poses, views, strict=True)]


def _fit(
    views: Sequence[BoardView], board: Board, width: int, height: int, kind: LensModel, free: int
) -> tuple[Intrinsics, list[Pose]]:
    """OpenCV's fit of its own model, whose pixel centres are whole numbers; for the fisheye model it is the start."""
    points = [board.corners[view.numbers].astype(np.float32)[:, None] for view in views]
    pixels = [(view.pixels - 0.5).astype(np.float32)[:, None] for view in views]
    flags = 0 if kind is LensModel.OPENCV and free > 4 else cv2.CALIB_FIX_K3
    _, matrix, lens, turns, shifts = cv2.calibrateCamera(points, pixels, (width, height), None, None, flags=flags)
    fx, fy, cx, cy = (float(matrix[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    coefficients = np.ravel(lens)[:5].tolist()
    poses = [(np.ravel(turn), np.ravel(shift)) for turn, shift in zip(turns, shifts, strict=True)]
    if kind is LensModel.OPENCV:
        return Intrinsics(fx, fy, cx + 0.5, cy + 0.5, Distortion(kind, tuple(coefficients))), poses
    # The angle is r - r^3 / 3 + ..., which the polynomial's k1 contains.
    start = Distortion(kind, (float(np.clip(coefficients[0] + 1 / 3, -0.3, 0.3)),))
    return _refined(Intrinsics(fx, fy, cx + 0.5, cy + 0.5, start), poses, views, board)


def _refined(
    k: Intrinsics, poses: list[Pose], views: Sequence[BoardView], board: Board
) -> tuple[Intrinsics, list[Pose]]:
    """Gauss-Newton on the intrinsics, all coefficients and all poses, with halved steps where the error would grow."""
    assert k.distortion is not None
    values, count = _values(k), len(k.distortion.coefficients)
    cost = _cost(k, poses, views, board)
    for _ in range(NEWTON_STEPS):
        parts = _linearised(k, poses, views, board, count)
        reduced = [_reduced(*part) for part in parts]
        step = -np.linalg.solve(sum(h for h, _ in reduced), sum(g for _, g in reduced))
        moves = [-np.linalg.lstsq(by_pose, error + by_lens @ step, rcond=None)[0] for by_lens, by_pose, error in parts]
        for share in 0.5 ** np.arange(8):
            tried = _camera(values + share * step, k.distortion.model)
            moved = [
                (turn + share * m[:3], shift + share * m[3:]) for (turn, shift), m in zip(poses, moves, strict=True)
            ]
            lower = _cost(tried, moved, views, board)
            if lower < cost:
                break
        else:
            return k, poses
        gain, cost, k, poses, values = (cost - lower) / cost, lower, tried, moved, values + share * step
        if gain < NEWTON_TOLERANCE:
            break
    return k, poses


def _values(k: Intrinsics) -> Array:
    assert k.distortion is not None
    return np.array([k.fx, k.fy, k.cx, k.cy, *k.distortion.coefficients])


def _camera(values: Array, model: LensModel) -> Intrinsics:
    fx, fy, cx, cy, *rest = values.tolist()
    return Intrinsics(fx, fy, cx, cy, Distortion(model, tuple(rest)))


def _cost(k: Intrinsics, poses: list[Pose], views: Sequence[BoardView], board: Board) -> float:
    return float(sum((_errors(k, pose, view, board) ** 2).sum() for pose, view in zip(poses, views, strict=True)))


def _linearised(
    k: Intrinsics, poses: list[Pose], views: Sequence[BoardView], board: Board, free: int
) -> list[tuple[Array, Array, Array]]:
    """For each view the errors [2 n] and their derivatives by the intrinsics with `free` coefficients, and by its pose
    [2 n, 6]."""
    assert k.distortion is not None
    values, model, out = _values(k)[: 4 + free], k.distortion.model, []
    for pose, view in zip(poses, views, strict=True):

        def own(change: Array, pose: Pose = pose, view: BoardView = view) -> Array:
            return _errors(_camera(values + change, model), pose, view, board)

        def moved(change: Array, pose: Pose = pose, view: BoardView = view) -> Array:
            return _errors(k, (pose[0] + change[:3], pose[1] + change[3:]), view, board)

        error = _errors(k, pose, view, board).ravel()
        out.append((_derivative(own, len(values)), _derivative(moved, 6), error))
    return out


def _reduced(by_lens: Array, by_pose: Array, error: Array) -> tuple[Array, Array]:
    """Information and gradient of the intrinsics from one view, with its pose free (Schur complement)."""
    cross = np.linalg.solve(by_pose.T @ by_pose, by_pose.T @ np.column_stack([by_lens, error]))
    left = by_lens.T @ by_lens - by_lens.T @ by_pose @ cross[:, :-1]
    return left, by_lens.T @ error - by_lens.T @ by_pose @ cross[:, -1]


def _errors(k: Intrinsics, pose: Pose, view: BoardView, board: Board) -> Array:
    """Projections minus corners, [n, 2]."""
    local = board.corners[view.numbers] @ cv2.Rodrigues(pose[0])[0].T + pose[1]
    return k.project(local) - view.pixels


def _sigmas(
    k: Intrinsics, poses: list[Pose], views: Sequence[BoardView], board: Board, free: int, noise_px: float
) -> dict[str, float]:
    """Standard deviations of the intrinsics and of the `free` coefficients, with the poses free."""
    assert k.distortion is not None
    names = k.distortion.model.names[:free]
    information = sum(_reduced(*part)[0] for part in _linearised(k, poses, views, board, free))
    sigma = noise_px * np.sqrt(np.diag(np.linalg.inv(information)))
    return dict(zip(("fx", "fy", "cx", "cy", *names), sigma.tolist(), strict=True))


def _derivative(function: Callable[[Array], Array], size: int) -> Array:
    """Of a function [n, 2] of `size` numbers at 0; [2 n, size]."""
    steps = STEP * np.eye(size)
    return np.stack([((function(step) - function(-step)) / (2 * STEP)).ravel() for step in steps], 1)
