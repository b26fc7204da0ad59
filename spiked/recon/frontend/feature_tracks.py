"""Corner tracks through rate images: pyramidal Lucas-Kanade with a forward-backward check.

Each track is aligned with the window of its first view, so that errors do not accumulate.
"""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._spikes as _spikes
import spiked.native._tracking as _tracking
from spiked.pose import Array
from spiked.recon.statistics import WHITE_PERCENTILE, median

Picture = NDArray[np.uint8]
Pyramid = list[NDArray[np.float32]]
"""See `pyramid`."""
WINDOW_PX = 13
"""Side of a track's template in px: `kWindow` of native/tracking/lucas_kanade.cpp. Images of less than twice this are
not halved."""
LEVELS = 4
"""Pyramid levels below full size for tracking from view to view."""
SLOW_MOTION_PX = 3.0
"""Below this motion between views one halving of the image suffices (decision 9)."""
PREDICTION_RADIUS_PX = 1.5
"""Largest distance of a track from its prediction."""
MIN_PREDICTED_SHARE = 0.85
"""With a smaller share of the tracks at their predictions, all are searched from the previous image (decision 9)."""
WHITE_STRIDE_PX = 3
"""Stride in px of the samples that set the white level: odd, to sample all sites of a mosaic."""
MIN_FOUND_SHARE = 0.6
"""Share of the points found that ends a search."""
REFILL_SHARE = 0.7
"""Share of `Tracks.target` below which new tracks are started."""
CORNER_QUALITY, CORNER_DISTANCE_PX, CORNER_BLOCK_PX = 0.003, 7, 5
"""Corners of new tracks: smallest eigenvalue over that of the best corner, distance from
other tracks, and side of the averaging window."""
BORDER_PX, CORNER_BORDER_PX = 4, 6
"""Tracks nearer to the border of the image end, and corners nearer to it are not used."""
THUMBNAIL_SCALE = 0.25
"""Size of the images of `search` over the full size."""
REACH_PX = 0.6
"""Largest forward-backward distance of a good track."""
TRACKED_NOISE, MOST_BLUR_PX = 0.02, 2.5
"""Noise of white photon images to which they are blurred, and how far at most, px (decision 27)."""
NO_WARPS = np.zeros((0, 2, 2), np.float32)
"""Templates are used as they are."""


def picture(rate: NDArray[np.float32], white: float) -> Picture:
    """Rates [H, W] as 8-bit values, square root for even contrast (noise grows with the rate); `white` becomes 255."""
    out = np.empty(rate.shape, np.uint8)
    _spikes.picture(np.ascontiguousarray(rate, np.float32), white, out)
    return out


def smoothed(rate: NDArray[np.float32], deviation: float) -> NDArray[np.float32]:
    """Rates [H, W] with a white noise of this standard deviation, blurred so far that it becomes `TRACKED_NOISE` of
    white: a Gaussian of s px divides it by 2 sqrt(pi) s."""
    noise = deviation / white_of(rate)
    sigma_px = min(max(noise / (TRACKED_NOISE * 2 * np.sqrt(np.pi)), 0.5), MOST_BLUR_PX)
    return np.asarray(cv2.GaussianBlur(rate, (0, 0), sigma_px), np.float32)


def white_of(rate: NDArray[np.float32]) -> float:
    """The rate shown as white: `WHITE_PERCENTILE` of every ninth pixel."""
    return max(float(_spikes.quantile(rate[::WHITE_STRIDE_PX, ::WHITE_STRIDE_PX], WHITE_PERCENTILE / 100)), 1e-6)


@dataclass
class Tracks:
    """The live tracks: `ids` [live] and where they are in the newest window."""

    target: int = 400
    """Number of live tracks."""
    far: bool = False
    """Frames are skipped between windows: the image shift is searched first."""
    reach_px: float = REACH_PX
    """Largest forward-backward distance of a good track."""
    next_id: int = 0
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    at: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Positions [live, 2] px (pixel centres at +0.5) in the newest window."""
    born: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    birthplace: Array = field(default_factory=lambda: np.zeros((0, 2)))
    pace: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Motion [live, 2] px to the newest window; NaN for tracks that are new in it."""
    pictures: dict[int, Pyramid] = field(default_factory=dict)
    """Of the newest window and of the first windows of live tracks."""
    newest_picture: Picture | None = None
    motion_px: float = np.inf
    """Median motion to the newest window."""
    newest: int = -1
    _spare: list[Pyramid] = field(default_factory=list)
    """Buffers for the next image."""

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: the pictures without their pyramids, without buffers."""
        margin = slice(_tracking.MARGIN_PX, -_tracking.MARGIN_PX)
        pictures = {window: levels[0][margin, margin].astype(np.uint8) for window, levels in self.pictures.items()}
        return vars(self) | {"pictures": pictures, "_spare": []}

    def __setstate__(self, state: dict[str, Any]) -> None:
        pictures = {window: pyramid(image, LEVELS) for window, image in state["pictures"].items()}
        vars(self).update(state | {"pictures": pictures})

    def add(self, window: int, image: Picture, after_gap: bool = False, warps: NDArray[np.float32] = NO_WARPS) -> float:
        """Track into a window and start new tracks; returns the median motion in px, 0 without tracks.

        After a gap the predictions are dropped. `warps` [live, 2, 2]: how offsets from a track in its first window
        appear in the new one.
        """
        if after_gap:
            self.pace[:] = np.nan
        motion, levels = 0.0, pyramid(image, LEVELS, self._spare.pop() if self._spare else None)
        if self.newest_picture is not None and len(self.ids):
            motion = self._follow(image, levels, warps)
        self.newest, self.newest_picture, self.motion_px = window, image, motion
        self.pictures[window] = levels
        if len(self.ids) < REFILL_SHARE * self.target:
            self._start(window, image)
        for old in set(self.pictures) - set(self.born.tolist()) - {window}:
            self._spare = [self.pictures.pop(old)]
        return motion

    def forget(self) -> None:
        """Drop all tracks, after a view whose tracks contradict the map."""
        self._keep(np.zeros(len(self.ids), bool))

    def resume(self, window: int, ids: NDArray[np.int64], at: Array) -> None:
        """Continue tracks of relocalised points in the newest window."""
        self._keep(~np.isin(self.ids, ids))
        self._begin(window, ids, at)

    def _keep(self, good: NDArray[np.bool_]) -> None:
        self.ids, self.at, self.pace = self.ids[good], self.at[good], self.pace[good]
        self.born, self.birthplace = self.born[good], self.birthplace[good]

    def _begin(self, window: int, ids: NDArray[np.int64], at: Array) -> None:
        self.ids = np.concatenate([self.ids, ids])
        self.at = np.concatenate([self.at, at])
        self.pace = np.concatenate([self.pace, np.full_like(at, np.nan)])
        self.born = np.concatenate([self.born, np.full(len(ids), window)])
        self.birthplace = np.concatenate([self.birthplace, at])

    def _follow(self, image: Picture, levels: Pyramid, warps: NDArray[np.float32]) -> float:
        """Refine tracks from their predictions; search them in the previous image if too few match."""
        moved, good = self._refined(levels, self._expected(), warps)
        if good.sum() <= MIN_PREDICTED_SHARE * len(good):
            moved, found = self._searched(image, levels)
            moved, good = self._refined(levels, moved, warps)
            good &= found
        height, width = image.shape
        motion = median(np.linalg.norm(moved - self.at, axis=1)[good]) if good.any() else 0.0
        good &= (moved > BORDER_PX).all(1) & (moved[:, 0] < width - BORDER_PX) & (moved[:, 1] < height - BORDER_PX)
        self.at, self.pace = moved, moved - self.at
        self._keep(good)
        return motion

    def _expected(self) -> Array | None:
        """Predicted positions [live, 2] at constant velocity, new tracks at the median; None if unreliable."""
        known = ~np.isnan(self.pace[:, 0])
        if self.far or self.motion_px >= SLOW_MOTION_PX or known.sum() <= MIN_FOUND_SHARE * len(known):
            return None
        return self.at + np.where(known[:, None], self.pace, [median(one) for one in self.pace[known].T])

    def _searched(self, image: Picture, levels: Pyramid) -> tuple[Array, NDArray[np.bool_]]:
        """Positions [live, 2] tracked from the previous image, and which were found."""
        assert self.newest_picture is not None
        if self.far:
            return search(self.newest_picture, image, self.at)
        before = self.pictures[self.newest]
        few = 1 if self.motion_px < SLOW_MOTION_PX else LEVELS
        moved, good = follow(before, levels, self.at, self.at, self.reach_px, few, back=False)
        if few < LEVELS and good.sum() < MIN_FOUND_SHARE * len(good):
            moved, good = follow(before, levels, self.at, self.at, self.reach_px, back=False)
        return moved, good

    def _refined(
        self, levels: Pyramid, guess: Array | None, warps: NDArray[np.float32]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Positions [live, 2] near a guess, aligned with the first window of each track, and which were found."""
        good = np.zeros(len(self.ids), bool)
        if guess is None:
            return self.at, good
        births, at = [levels[0] for levels in self.pictures.values()], np.array(guess)
        number = {window: n for n, window in enumerate(self.pictures)}
        row = np.array([number[window] for window in self.born.tolist()], np.int64)
        _tracking.refine_tracks(
            births, row, levels[0], self.birthplace, warps, at, self.reach_px, PREDICTION_RADIUS_PX, good
        )
        return at, good

    def _start(self, window: int, image: Picture) -> None:
        mask, inside = np.zeros(image.shape, np.uint8), slice(CORNER_BORDER_PX, -CORNER_BORDER_PX)
        mask[inside, inside] = 255
        for x, y in self.at:
            cv2.circle(mask, (int(x), int(y)), CORNER_DISTANCE_PX, 0, -1)
        fresh = find_corners(image, self.target - len(self.ids), CORNER_DISTANCE_PX, mask=mask)
        self._begin(window, self.next_id + np.arange(len(fresh)), fresh)
        self.next_id += len(fresh)


def find_corners(
    image: Picture, count: int, distance_px: float, *, block_px: int = CORNER_BLOCK_PX, mask: Picture | None = None
) -> Array:
    """The strongest corners [n, 2] px of an image, at most `count`, at least `distance_px` apart, where `mask` is not
    0."""
    corners = cv2.goodFeaturesToTrack(image, count, CORNER_QUALITY, distance_px, mask=mask, blockSize=block_px)
    return np.zeros((0, 2)) if corners is None else corners[:, 0].astype(float) + 0.5


def flow(
    a: Picture, b: Picture, start: Array, guess: Array, reach_px: float, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Positions in `b` of the points `start` of `a`, and which pass the forward-backward check."""
    return follow(pyramid(a, levels), pyramid(b, levels), start, guess, reach_px)


def follow(
    a: Pyramid,
    b: Pyramid,
    start: Array,
    guess: Array,
    reach_px: float,
    levels: int | None = None,
    back: bool = True,
) -> tuple[Array, NDArray[np.bool_]]:
    """As `flow`, for pyramids; `levels` limits the levels used, without `back` there is no forward-backward check."""
    at, good = np.array(guess, float), np.empty(len(guess), bool)
    count = min(len(a), len(b)) if levels is None else levels + 1
    _tracking.track(a[:count], b[:count], np.ascontiguousarray(start), at, reach_px, back, good)
    return at, good


def pyramid(image: Picture, levels: int, into: Pyramid | None = None) -> Pyramid:
    """An image and up to `levels` halvings of it, with margins; written to `into`, of the same size, if given."""
    small = [image]
    while len(small) <= levels and min(small[-1].shape) > 2 * WINDOW_PX:
        small.append(np.asarray(cv2.pyrDown(small[-1]), np.uint8))
    margin = 2 * _tracking.MARGIN_PX
    out = into or [np.empty((len(one) + margin, one.shape[1] + margin), np.float32) for one in small]
    for one, framed in zip(small, out, strict=True):
        _tracking.pad(one, framed)
    return out


def search(a: Picture, b: Picture, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Positions in `b` of `points` [n, 2] of `a` after a large motion: phase correlation of thumbnails (Hann window),
    then `flow`; and which points pass the forward-backward check."""
    s = THUMBNAIL_SCALE
    small = [cv2.resize(p, None, fx=s, fy=s, interpolation=cv2.INTER_AREA).astype(np.float32) for p in (a, b)]
    shift, _ = cv2.phaseCorrelate(small[0], small[1], cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F))
    best = points, np.zeros(len(points), bool)
    for guess in (np.array(shift) / s, np.zeros(2)):
        at, good = flow(a, b, points, points + guess, REACH_PX, LEVELS)
        good &= (at > BORDER_PX).all(1) & (at < np.array(b.shape[::-1]) - BORDER_PX).all(1)
        if good.sum() > best[1].sum():
            best = at, good
        if good.sum() > MIN_FOUND_SHARE * len(points):
            break
    return best
