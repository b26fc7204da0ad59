"""How far pictures are apart, and pictures between them along dense optical flow."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.sensor import Image
from spiked.simulate.pictures.light import Node
from spiked.simulate.view import LUMINANCE

Flow = NDArray[np.float32]
"""Where each pixel of one picture lies in another, minus where it is: pixels [H, W, 2]."""

_FEATURES = 400
"""Corners that are followed from one picture to the next."""
_WINDOW_PX = 15
"""Side of the window around a corner that is followed."""
_LEVELS = 5
"""Halvings of the picture in which motion is searched first: corners are followed over some hundred pixels."""
_BACK_PX = 1.0
"""A corner that is followed back to another place than this near its own is lost."""
_STILL_PX = 0.02
"""Motion below which pictures are taken for equal: that of noise."""
_MOST_PARTS = 512
"""Most pictures made between two."""
_OCCLUDED_PX = 1.0
"""Flow there and back that misses by this much: half of the weight of a pixel is lost."""


@dataclass(frozen=True)
class Spacing:
    """Image motion between consecutive pictures, of corners that were followed."""

    median_px: float
    p95_px: float
    """95 % of the corners moved less."""
    followed: float
    """Share of the corners that were found again."""
    pairs: int
    """Pairs of pictures that were measured."""

    @classmethod
    def of(cls, moved: list[NDArray[np.float32]], corners: int, pairs: int) -> "Spacing":
        """moved: lengths in pixels [n] of each pair."""
        lengths = np.concatenate(moved) if moved else np.zeros(0, np.float32)
        if len(lengths) == 0:
            return cls(0.0, 0.0, 1.0 if corners == 0 else 0.0, pairs)
        median, p95 = np.percentile(lengths, [50, 95])
        return cls(float(median), float(p95), len(lengths) / corners, pairs)


def shown(light: Image) -> NDArray[np.uint8]:
    """Light [H, W] or [H, W, 3] as a grey picture of 8 bits, in which dark places have contrast, too."""
    grey = light @ LUMINANCE if light.ndim == 3 else light
    return np.asarray(np.round(255 * np.sqrt(np.clip(grey, 0, 1))), np.uint8)


def corners_moved(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[NDArray[np.float32], int]:
    """Lengths [n] in pixels by which corners of one picture have moved in the next, and the number of corners."""
    corners = cv2.goodFeaturesToTrack(first, _FEATURES, 0.01, 5)
    if corners is None:
        return np.zeros(0, np.float32), 0
    size = (_WINDOW_PX, _WINDOW_PX)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=size, maxLevel=_LEVELS)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=size, maxLevel=_LEVELS)
    corners, there, back = (points.reshape(-1, 2) for points in (corners, there, back))
    kept = (found.ravel() > 0) & (found_back.ravel() > 0) & (np.linalg.norm(back - corners, axis=1) < _BACK_PX)
    return np.linalg.norm(there - corners, axis=1)[kept].astype(np.float32), len(corners)


def moved_nodes(nodes: Iterator[Node], step_px: float) -> Iterator[Node]:
    """The nodes, and between two of them pictures along the flow, at most about `step_px` apart."""
    before = next(nodes)
    yield before
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    shown_before = shown(before.light)
    for after in nodes:
        shown_after = shown(after.light)
        there: Flow = dis.calc(shown_before, shown_after, None)
        length = float(np.percentile(np.linalg.norm(there[::4, ::4], axis=2), 95))
        parts = min(int(np.ceil(length / step_px)), _MOST_PARTS)
        if length > _STILL_PX and parts > 1:
            between = Between(before.light, after.light, there, dis.calc(shown_after, shown_before, None))
            for part in range(1, parts):
                share = part / parts
                yield Node(before.frame + share * (after.frame - before.frame), between.at(share))
        yield after
        before, shown_before = after, shown_after


class Between:
    """Pictures between two, each pixel along its way.

    The flow at a moment is put together from both flows as if each pixel moved evenly (Jiang et al., Super SloMo, CVPR
    2018, Eq 4). Where the way there and the way back do not meet, a pixel is hidden in one of the pictures, and the
    other one has the weight.
    """

    def __init__(self, first: Image, last: Image, there: Flow, back: Flow) -> None:
        """first, last: light [H, W] or [H, W, 3]; there, back: flow from the first to the last, and back."""
        self._first, self._last, self._there, self._back = first, last, there, back
        height, width = there.shape[:2]
        self._grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)
        self._seen_first = self._meets(there, back)
        self._seen_last = self._meets(back, there)

    def _meets(self, there: Flow, back: Flow) -> Image:
        """Weight [H, W] of the pixels of a picture by how well the flow leads there and back."""
        missed = there + _sampled(back, self._grid + there)
        return np.asarray(1 / (1 + np.square(missed / np.float32(_OCCLUDED_PX)).sum(2)), np.float32)

    def at(self, share: float) -> Image:
        """The light at a moment from 0, the first picture, to 1, the last."""
        s = np.float32(share)
        to_first = self._grid + (-(1 - s) * s * self._there + s * s * self._back)
        to_last = self._grid + ((1 - s) * (1 - s) * self._there - s * (1 - s) * self._back)
        of_first = (1 - s) * _sampled(self._seen_first, to_first)
        of_last = s * _sampled(self._seen_last, to_last)
        weight = of_last / (of_first + of_last)
        first, last = _sampled(self._first, to_first), _sampled(self._last, to_last)
        return np.asarray(first + (weight if first.ndim == 2 else weight[..., None]) * (last - first), np.float32)


def _sampled(image: Image, at: Flow) -> Image:
    return np.asarray(cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
