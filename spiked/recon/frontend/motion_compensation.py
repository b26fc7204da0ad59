"""Motion compensation: spikes are warped along the image motion to one time before they are summed.

In low light a window is long and fast motion blurs it. The image motion between neighbouring views is modelled as a
homography (rotation, planes) plus a smooth residual (parallax). The phases of neighbouring pixels are independent, so
the spikes of each frame are an unbiased sample of the radiance at that frame, and so is the sum of warped spikes. On a
mosaic, motion brings every colour to every pixel.
"""

from dataclasses import dataclass
from dataclasses import field as dataclass_field

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._tracking as _tracking
from spiked.blocks import aligned_window
from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture, find_corners, flow, picture, white_of
from spiked.sensor import BitOrder, Image, Sensor

FIELD_CELL_PX = 16
"""Spacing of the nodes of a motion field in px."""
SMOOTH_PX = 32.0
"""Standard deviation of the Gaussian that spreads a track's residual motion beyond the homography."""
COARSE_FRAMES = 8
"""Frames of the blurred windows that the motion is estimated from."""
REACH_FRAMES = 12
"""Frames on either side of a time that are warped to it; as many as the map is fitted to (`WARP_FRAMES`, decision
8)."""
MIN_FIELD_TRACKS = 12
"""Tracks that a motion field needs: three times those of a homography."""
HOMOGRAPHY_INLIER_PX, MIN_HOMOGRAPHY_INLIERS = 3.0, 0.3
"""Largest residual of a track that agrees with the homography, and the share of the tracks that has to."""
RESIDUAL_CLIP, MIN_RESIDUAL_PX = 4.0, 0.5
"""Tracks whose residual exceeds this many medians are left out; the median counts as at least so large."""
MIN_COVERAGE = 0.25
"""Share of the frames that have to cover a pixel of a warped image."""
COARSE_BLUR_PX, COARSE_CORNERS, COARSE_DISTANCE_PX, COARSE_BLOCK_PX = 1.5, 300, 6, 7
"""Corners of the blurred windows, at half size: standard deviation of the blur, number, distance, averaging window."""
COARSE_REACH_PX, COARSE_LEVELS = 0.75, 3
"""Largest forward-backward distance of their tracks, and pyramid levels below half size."""
BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)
"""Kernel whose 3x3 product weighs the colours of a mosaic alike at every pixel."""

Field = NDArray[np.float64]
"""Displacements [rows, columns, 2] in px at nodes `FIELD_CELL_PX` apart, beginning at the corner of the image."""


def nodes(width: int, height: int) -> Array:
    """Positions of a field's nodes, [rows, columns, 2] px."""
    columns, rows = -(-width // FIELD_CELL_PX) + 1, -(-height // FIELD_CELL_PX) + 1
    x, y = np.meshgrid(FIELD_CELL_PX * np.arange(columns), FIELD_CELL_PX * np.arange(rows))
    return np.stack([x, y], 2).astype(float)


def fit_field(start: Array, end: Array, width: int, height: int) -> Field | None:
    """The motion field through tracks from `start` [n, 2] to `end` [n, 2]; None without a consistent homography."""
    if len(start) < MIN_FIELD_TRACKS:
        return None
    homography, inlier = cv2.findHomography(start, end, cv2.RANSAC, HOMOGRAPHY_INLIER_PX)
    if homography is None or inlier.mean() < MIN_HOMOGRAPHY_INLIERS:
        return None
    places = nodes(width, height)
    rest = end - _through(homography, start)
    size = np.linalg.norm(rest, axis=1)
    keep = size < RESIDUAL_CLIP * max(float(np.median(size)), MIN_RESIDUAL_PX)
    distance = ((places[:, :, None] - start[keep]) ** 2).sum(3)
    weight = np.exp(-0.5 * distance / SMOOTH_PX**2)
    moved = np.einsum("rcn,nd->rcd", weight, rest[keep]) / (weight.sum(2, keepdims=True) + 0.5)
    return np.asarray(_through(homography, places.reshape(-1, 2)).reshape(places.shape) - places + moved)


def _through(homography: Array, points: Array) -> Array:
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def at(field: Field, points: Array) -> Array:
    """The field at points [..., 2] px, bilinear; constant outside."""
    return _bilinear(field, points / FIELD_CELL_PX, ())


def _bilinear(values: Array, xy: Array, leading: tuple[NDArray[np.int64], ...]) -> Array:
    """Values [..., rows, columns, C] at places xy [..., 2] in units of nodes, constant outside; `leading` indexes the
    axes before the rows."""
    rows, columns = values.shape[-3:-1]
    i = np.clip(np.floor(xy).astype(int), 0, [columns - 2, rows - 2])
    u = np.clip(xy - i, 0, 1)
    x, y, a, b = i[..., 0], i[..., 1], u[..., :1], u[..., 1:]
    top = (1 - a) * values[(*leading, y, x)] + a * values[(*leading, y, x + 1)]
    low = (1 - a) * values[(*leading, y + 1, x)] + a * values[(*leading, y + 1, x + 1)]
    return np.asarray((1 - b) * top + b * low)


def warp_frames(
    frames: NDArray[np.uint8], sensor: Sensor, grids: NDArray[np.float32], cell: int = FIELD_CELL_PX
) -> Image:
    """Mean spikes a frame [H, W] of stored frames [n, frame_bytes], each moved by its grid [n, rows, columns, 2] px of
    nodes `cell` px apart.

    On a mosaic every pixel mixes the colours of the sites warped to it. Pixels without any hold the mean.
    """
    spikes = np.zeros((sensor.height, sensor.width), np.float32)
    weight = np.zeros((-(-sensor.height // 4), -(-sensor.width // 4)), np.float32)
    _tracking.warp_spikes(
        frames,
        sensor.width,
        sensor.height,
        sensor.row_stride,
        sensor.flipped,
        sensor.bit_order is BitOrder.MSB,
        grids,
        cell,
        spikes,
        weight,
    )
    full = cv2.resize(weight, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)[: sensor.height, : sensor.width]
    spikes = cv2.sepFilter2D(spikes, cv2.CV_32F, BINOMIAL, BINOMIAL, borderType=cv2.BORDER_REFLECT_101)
    seen = full > MIN_COVERAGE * len(grids)
    mean = float(spikes[seen].sum() / max(full[seen].sum(), 1e-9))
    return np.asarray(np.where(seen, spikes / np.maximum(full, 1e-6), mean), np.float32)


@dataclass
class Motions:
    """Motion fields between moments: `fields[k]` leads from `times[k]` to `times[k + 1]` (frames), None if unknown."""

    width: int
    height: int
    margin: float
    """Frames before the first and after the last time over which their motion is extrapolated."""
    times: list[float] = dataclass_field(default_factory=list)
    fields: list[Field | None] = dataclass_field(default_factory=list)

    def reach(self, reference: int, frames: float) -> tuple[float, float]:
        """The span around `times[reference]`, at most `frames` long to either side, over which motion is known."""
        moment = self.times[reference]
        low, high = self.times[0] - self.margin, self.times[-1] + self.margin
        for k in range(reference, len(self.fields)):
            if self.fields[k] is None:
                high = self.times[k]
                break
        for k in range(reference - 1, -1, -1):
            if self.fields[k] is None:
                low = self.times[k + 1]
                break
        # Errors of the motion cancel between the two sides, so both have about the same length.
        shorter = min(moment - low, high - moment)
        reach = min(frames, shorter + 2 * self.margin)
        return max(low, moment - reach), min(high, moment + reach)

    def forget(self, before: float) -> None:
        """Drop times more than one interval before a time."""
        while len(self.times) > 2 and self.times[1] < before:
            del self.times[0], self.fields[0]

    def grids(self, reference: int, frames: Array) -> NDArray[np.float32]:
        """For each frame time [n] the displacement field to `times[reference]`, [n, rows, columns, 2] px."""
        places = nodes(self.width, self.height)
        moments = np.array(self.times)
        first = max(int(np.searchsorted(moments, frames.min(), "right")) - 1, 0)
        last = min(int(np.searchsorted(moments, frames.max())), len(moments) - 1)
        moved = {reference: np.zeros_like(places)}  # displacement of the reference's nodes at each time
        for k in range(reference, last):
            moved[k + 1] = moved[k] + at(self._known(k), places + moved[k])
        for k in range(reference - 1, first - 1, -1):
            moved[k] = moved[k + 1] + back(self._known(k), places + moved[k + 1])
        low = np.clip(np.searchsorted(moments, frames, "right") - 1, first, max(last - 1, first))
        high = np.minimum(low + 1, last)
        share = (frames - moments[low]) / np.maximum(moments[high] - moments[low], 1e-9)
        table = np.stack([moved[k] for k in range(first, last + 1)])
        blend = share[:, None, None, None]
        return -inverted((1 - blend) * table[low - first] + blend * table[high - first], places).astype(np.float32)

    def _known(self, interval: int) -> Field:
        field = self.fields[interval]
        assert field is not None, "frames beyond `reach`"
        return field


class MotionCompensator:
    """Estimates the image motion and renders the motion-compensated images of views."""

    def __init__(self, sensor: Sensor, interval: int) -> None:
        self.sensor, self.interval = sensor, interval
        self._motions = Motions(sensor.width, sensor.height, 0.5 * interval)
        self._last: Picture | None = None

    def estimate(self, frames: NDArray[np.uint8], first: int, begin: float) -> None:
        """Estimate the motion in stored `frames` [n, frame_bytes], the first of absolute index `first`, every
        `interval` frames from `begin` on."""
        motions = self._motions
        stop = first + len(frames)
        half = max(COARSE_FRAMES, self.interval) // 2
        while (time := motions.times[-1] + self.interval if motions.times else begin) + half <= stop:
            low = max(int(time) - half, first)
            window = aligned_window(
                frames[low - first : int(time) + half - first], self.sensor, low, low, int(time) + half
            )
            small = _small(window.count)
            if self._last is not None:
                motions.fields.append(_coarse_motion(self._last, small, self.sensor))
            motions.times.append(time)
            self._last = small

    def sharp(self, frames: NDArray[np.uint8], first: int, time: float) -> Image | None:
        """The image at a time in spikes a frame [H, W]; None if the motion around it is unknown."""
        motions = self._motions
        if time not in motions.times:
            return None
        reference = motions.times.index(time)
        low, high = motions.reach(reference, REACH_FRAMES)
        begin, end = max(round(low), first), min(round(high), first + len(frames))
        if len(motions.times) < 2 or end - begin < self.interval:
            return None
        grids = motions.grids(reference, np.arange(begin, end, dtype=float) + 0.5)
        motions.forget(time - REACH_FRAMES)
        return warp_frames(frames[begin - first : end - first], self.sensor, grids)


def speed(frames: NDArray[np.uint8], sensor: Sensor) -> float:
    """Median image motion in px a frame at the beginning of stored frames [n, frame_bytes]; 0 without
    tracks or with fewer than two coarse windows."""
    n = COARSE_FRAMES
    if len(frames) < 2 * n:
        return 0.0
    a, b = (_small(aligned_window(frames[i : i + n], sensor, 0, 0, n).count) for i in (0, n))
    field = _coarse_motion(a, b, sensor)
    return 0.0 if field is None else float(np.median(np.linalg.norm(field, axis=2))) / n


def drift(frames: NDArray[np.uint8], sensor: Sensor) -> float:
    """Median image motion in px through stored frames [n, frame_bytes], from the spike counts of both halves; 0
    without tracks."""
    half = len(frames) // 2
    a, b = (_small(aligned_window(frames[i : i + half], sensor, 0, 0, half).count) for i in (0, half))
    field = _coarse_motion(a, b, sensor)
    return 0.0 if field is None else 2 * float(np.median(np.linalg.norm(field, axis=2)))


def _small(count: NDArray[np.uint16]) -> Picture:
    """Spike counts at half the size, each pixel the mean of a 2x2 tile, as an 8-bit image."""
    height, width = count.shape
    even = count[: height // 2 * 2, : width // 2 * 2].astype(np.float32)
    half = cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return picture(half, white_of(half))


def _coarse_motion(a: Picture, b: Picture, sensor: Sensor) -> Field | None:
    blurred = cv2.GaussianBlur(a, (0, 0), COARSE_BLUR_PX)
    start = find_corners(blurred, COARSE_CORNERS, COARSE_DISTANCE_PX, block_px=COARSE_BLOCK_PX)
    if not len(start):
        return None
    end, good = flow(a, b, start, start, reach_px=COARSE_REACH_PX, levels=COARSE_LEVELS)
    return fit_field(2 * start[good], 2 * end[good], sensor.width, sensor.height)


def back(field: Field, points: Array) -> Array:
    """The inverse displacement at points [..., 2], by fixed-point iteration."""
    out = -at(field, points)
    for _ in range(2):
        out = -at(field, points + out)
    return out


def inverted(fields: Array, places: Array) -> Array:
    """The fields [n, rows, columns, 2] indexed by their end points: the displacement that ended at each node."""
    out = fields
    number = np.arange(len(fields))[:, None, None]
    for _ in range(3):
        out = _bilinear(fields, (places - out) / FIELD_CELL_PX, (number,))
    return out
