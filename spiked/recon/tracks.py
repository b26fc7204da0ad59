"""Corners followed through rate images: pyramidal Lucas-Kanade with a forward-backward check.

Each track keeps the window where it was born and is re-aligned against it, so that small errors do not add up.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._odometry as _odometry
from spiked.pose import Array
from spiked.recon.robust import median

Picture = NDArray[np.uint8]
Pyramid = list[NDArray[np.float32]]
"""See `pyramid`."""
WINDOW_PX = 13
"""Edge of what a track is recognised by."""
LEVELS = 4
"""Times that a picture is halved to follow tracks from one view to the next."""
NEAR_PX = 3.0
"""After so much motion from one view to the next half the size is small enough to look at."""
NEAR_GUESS_PX = 1.5
"""A track is where it was expected to this many pixels."""
AS_EXPECTED = 0.85
"""With fewer of them where they were expected something else happened, and all are looked for."""
LOOKED = 3
"""Pixels from one to the next, across and down, that the white of a picture is found from: odd, to meet all sites of a
mosaic."""
SURE = 0.6
"""With so many of the points found, no other place is tried."""


def picture(rate: NDArray[np.float32], white: float) -> Picture:
    """Rates [H, W] as 8-bit values, square root for even contrast (noise grows with the rate); `white` becomes 255."""
    out = np.empty(rate.shape, np.uint8)
    _odometry.picture(np.ascontiguousarray(rate, np.float32), white, out)
    return out


def white_of(rate: NDArray[np.float32]) -> float:
    """The rate that is shown as white, brighter than 99.5 % of every ninth pixel."""
    return max(float(_odometry.quantile(rate[::LOOKED, ::LOOKED], 0.995)), 1e-6)


@dataclass
class Tracks:
    """The live tracks: `ids` [live] and where they are in the newest window."""

    target: int = 400
    """How many live tracks are kept."""
    far: bool = False
    """The image may move by dozens of pixels from one window to the next: it is looked for first."""
    reach_px: float = 0.6
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
    """Of the newest window and those in which tracks were born."""
    newest_picture: Picture | None = None
    motion_px: float = np.inf
    """Median motion to the newest window."""
    newest: int = -1
    _spare: list[Pyramid] = field(default_factory=list)
    """Room that the next picture may take."""

    def add(self, window: int, image: Picture, after_gap: bool = False) -> float:
        """Follow all tracks into a window and start new ones; returns the median motion in px (0 where none was found).

        Nobody knows how the camera went on in a gap.
        """
        if after_gap:
            self.pace[:] = np.nan
        motion, levels = 0.0, pyramid(image, LEVELS, self._spare.pop() if self._spare else None)
        if self.newest_picture is not None and len(self.ids):
            motion = self._follow(image, levels)
        self.newest, self.newest_picture, self.motion_px = window, image, motion
        self.pictures[window] = levels
        if len(self.ids) < 0.7 * self.target:
            self._start(window, image)
        for old in set(self.pictures) - set(self.born.tolist()) - {window}:
            self._spare = [self.pictures.pop(old)]
        return motion

    def forget(self) -> None:
        """Let go of all tracks, where what they follow cannot be what they followed."""
        self._keep(np.zeros(len(self.ids), bool))

    def resume(self, window: int, ids: NDArray[np.int64], at: Array) -> None:
        """Continue tracks that were found again in the newest window."""
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

    def _follow(self, image: Picture, levels: Pyramid) -> float:
        """Where tracks are expected is where they began as it looks now, or else they are looked for."""
        moved, good = self._refined(levels, self._expected())
        if good.sum() <= AS_EXPECTED * len(good):
            moved, found = self._sought(image, levels)
            moved, good = self._refined(levels, moved)
            good &= found
        height, width = image.shape
        motion = median(np.linalg.norm(moved - self.at, axis=1)[good]) if good.any() else 0.0
        good &= (moved > 4).all(1) & (moved[:, 0] < width - 4) & (moved[:, 1] < height - 4)
        self.at, self.pace = moved, moved - self.at
        self._keep(good)
        return motion

    def _expected(self) -> Array | None:
        """Places [live, 2] if all go on as they went, None where that says little; new ones go as most do."""
        known = ~np.isnan(self.pace[:, 0])
        if self.far or self.motion_px >= NEAR_PX or known.sum() <= SURE * len(known):
            return None
        return self.at + np.where(known[:, None], self.pace, [median(one) for one in self.pace[known].T])

    def _sought(self, image: Picture, levels: Pyramid) -> tuple[Array, NDArray[np.bool_]]:
        """Places [live, 2] by the newest picture, and which were found."""
        assert self.newest_picture is not None
        if self.far:
            return search(self.newest_picture, image, self.at)
        before = self.pictures[self.newest]
        few = 1 if self.motion_px < NEAR_PX else LEVELS
        moved, good = follow(before, levels, self.at, self.at, self.reach_px, few, back=False)
        if few < LEVELS and good.sum() < SURE * len(good):
            moved, good = follow(before, levels, self.at, self.at, self.reach_px, back=False)
        return moved, good

    def _refined(self, levels: Pyramid, guess: Array | None) -> tuple[Array, NDArray[np.bool_]]:
        """Places [live, 2] near a guess by how tracks looked when they were born, and which were found."""
        good = np.zeros(len(self.ids), bool)
        if guess is None:
            return self.at, good
        births, at = [levels[0] for levels in self.pictures.values()], np.array(guess)
        number = {window: n for n, window in enumerate(self.pictures)}
        row = np.array([number[window] for window in self.born.tolist()], np.int64)
        _odometry.refine(births, row, levels[0], self.birthplace, at, self.reach_px, NEAR_GUESS_PX, good)
        return at, good

    def _start(self, window: int, image: Picture) -> None:
        mask = np.full(image.shape, 255, np.uint8)
        mask[:6], mask[-6:], mask[:, :6], mask[:, -6:] = 0, 0, 0, 0
        for x, y in self.at:
            cv2.circle(mask, (int(x), int(y)), 7, 0, -1)
        wanted = self.target - len(self.ids)
        corners = cv2.goodFeaturesToTrack(image, wanted, 0.003, 7, mask=mask, blockSize=5)
        if corners is None:
            return
        fresh = corners[:, 0].astype(float) + 0.5
        self._begin(window, self.next_id + np.arange(len(fresh)), fresh)
        self.next_id += len(fresh)


def flow(
    a: Picture, b: Picture, start: Array, guess: Array, reach_px: float, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Positions in `b` of the points `start` of `a`, and which came back to where they started."""
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
    """As `flow`, for pictures that are used again; with `levels` only so many of the smaller ones are looked at, and
    those that are found need not come `back`."""
    at, good = np.array(guess, float), np.empty(len(guess), bool)
    count = min(len(a), len(b)) if levels is None else levels + 1
    _odometry.follow(a[:count], b[:count], np.ascontiguousarray(start), at, reach_px, back, good)
    return at, good


def pyramid(image: Picture, levels: int, into: Pyramid | None = None) -> Pyramid:
    """A picture and up to so many smaller ones, each half the size of the one before, all with a margin; written over
    one of the same size, if given."""
    small = [image]
    while len(small) <= levels and min(small[-1].shape) > 2 * WINDOW_PX:
        small.append(np.asarray(cv2.pyrDown(small[-1]), np.uint8))
    margin = 2 * _odometry.MARGIN_PX
    out = into or [np.empty((len(one) + margin, one.shape[1] + margin), np.float32) for one in small]
    for one, framed in zip(small, out, strict=True):
        _odometry.framed(one, framed)
    return out


def search(a: Picture, b: Picture, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where `points` [n, 2] of picture `a` are in `b`, possibly far away: a shift from phase correlation of thumbnails
    (Hann window), then the flow from there; and which of them came back."""
    small = [cv2.resize(p, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.float32) for p in (a, b)]
    shift, _ = cv2.phaseCorrelate(small[0], small[1], cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F))
    best = points, np.zeros(len(points), bool)
    for guess in (4.0 * np.array(shift), np.zeros(2)):
        at, good = flow(a, b, points, points + guess, 0.6, levels=4)
        good &= (at > 4).all(1) & (at < np.array(b.shape[::-1]) - 4).all(1)
        if good.sum() > best[1].sum():
            best = at, good
        if good.sum() > SURE * len(points):
            break
    return best
