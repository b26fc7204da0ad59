"""Checks the stated colour mosaic, and the order of bits, against the pixels of a recording."""

from dataclasses import dataclass

import cv2
import numpy as np

from spiked.blocks import aligned_window
from spiked.recon.frontend.bit_order_check import bit_order_warning
from spiked.recording import Recording
from spiked.sensor import Image, Mosaic, Sensor

GREEN_RATIO = 1.25
"""Factor by which one diagonal must agree better than the other to be green."""
MIN_SITE_CONTRAST = 0.03
"""Relative difference of the sites' mean rates below which the sensor or the scene is grey."""

UNDECLARED_RATIO = 2.0
"""Factor from which a sensor that is said to be grey has a mosaic: 3.9 to 11.4 of the colour streams of decision 22, at
most 1.03 of the grey ones."""
CHECKED_FRAMES = 80
"""Frames at the start of a recording by which its mosaic is checked."""
LEAST_FRAMES = 16
"""Frames without which it is not: a preview has as many."""

_ON_MAIN_DIAGONAL = (Mosaic.GRBG, Mosaic.GBRG)
_BESIDE = (Mosaic.BGGR, Mosaic.RGGB)
_MIRRORED = {
    Mosaic.BGGR: Mosaic.GRBG,
    Mosaic.GRBG: Mosaic.BGGR,
    Mosaic.RGGB: Mosaic.GBRG,
    Mosaic.GBRG: Mosaic.RGGB,
}
"""The same sensor read from the other end of its columns."""


@dataclass(frozen=True)
class Green:
    """Where the two green sites of each 2x2 tile are."""

    main: bool
    """On (0,0) and (1,1), not on (0,1) and (1,0)."""
    ratio: float
    """Disagreement of the other diagonal over that of this one."""

    @property
    def clear(self) -> bool:
        """Whether the evidence suffices."""
        return self.ratio > GREEN_RATIO


def find_green(rate: Image) -> Green | None:
    """From an upright rate image [H, W]; None where the four sites look alike, as of a grey sensor.

    Two sites of one colour differ by the scene's detail only, two of different colours by its colours too.
    """
    height, width = rate.shape[0] // 2 * 2, rate.shape[1] // 2 * 2
    even = rate[:height, :width]
    # Each site's plane at the tile's middle, so that an edge does not look like a colour.
    moved = [_towards_middle(even[r::2, c::2], r, c) for r in (0, 1) for c in (0, 1)]
    means = np.array([float(plane.mean()) for plane in moved])
    main, other = _disagreement(moved[0], moved[3]), _disagreement(moved[1], moved[2])
    ratio = max(main, other) / max(min(main, other), 1e-9)
    if ratio < GREEN_RATIO and np.ptp(means) < MIN_SITE_CONTRAST * max(float(means.mean()), 1e-9):
        return None
    return Green(main < other, ratio)


def contradicts(mosaic: Mosaic, rate: Image) -> Mosaic | None:
    """The likelier mosaic if the image clearly contradicts the stated one, else None."""
    green = find_green(rate)
    if green is None or not green.clear or green.main == (mosaic in _ON_MAIN_DIAGONAL):
        return None
    return _MIRRORED[mosaic]


def detect(rate: Image, said: Mosaic | None) -> Mosaic | None:
    """The mosaic estimated from the image, or the stated one if the evidence is weak.

    Red and blue cannot be distinguished: they stay as stated, or as of a sensor that is read as BGGR bottom up.
    """
    green = find_green(rate)
    if green is None:
        return said
    guess = said or Mosaic.BGGR
    if not green.clear:
        return guess
    return guess if green.main == (guess in _ON_MAIN_DIAGONAL) else _MIRRORED[guess]


def _towards_middle(plane: Image, row: int, column: int) -> Image:
    """Shifted by a quarter of its own spacing towards the middle of the tile."""
    shift = np.array([[1, 0, 0.25 * (1 - 2 * column)], [0, 1, 0.25 * (1 - 2 * row)]], np.float32)
    moved = cv2.warpAffine(
        np.ascontiguousarray(plane),
        shift,
        plane.shape[::-1],
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(cv2.GaussianBlur(moved, (0, 0), 1.0), np.float32)


def _disagreement(a: Image, b: Image) -> float:
    """Median difference relative to the brightness."""
    return float(np.mean(np.abs(a - b)) / max(float(np.mean(a + b)), 1e-9))


def mosaic_warning(stated: Mosaic | None, rate: Image) -> str | None:
    """A warning where the pixels [H, W] contradict the stated mosaic, or show one where none is stated."""
    if stated is None:
        green = find_green(rate)
        if green is None or green.ratio < UNDECLARED_RATIO:
            return None
        first, second = _ON_MAIN_DIAGONAL if green.main else _BESIDE
        return (
            "by its pixels the sensor has a colour mosaic, which is not stated, so that it is taken as grey: state "
            f"mosaic {first} or {second}, which differ in red and blue only"
        )
    if find_green(rate) is None:
        return (
            f"the colour mosaic is said to be {stated}, but the pixels show none: the sensor is grey, or all that it "
            "sees is; of a grey sensor do not state a mosaic"
        )
    likelier = contradicts(stated, rate)
    if likelier is None:
        return None
    return (
        f"the colour mosaic is said to be {stated}, but by the pixels green is where {likelier} has it: "
        "colours and fine detail will be wrong; give --mosaic auto, or correct the sidecar's cfa; if the mosaic is "
        "right, the rows come the other way up: give --upright or --flipped"
    )


def layout_warnings(sensor: Sensor, rate: Image) -> list[str]:
    """What an upright rate image [H, W] contradicts: the order of bits, else the mosaic."""
    warning = bit_order_warning(sensor.bit_order, rate) or mosaic_warning(sensor.mosaic, rate)
    return [] if warning is None else [warning]


def recorded_layout_warnings(recording: Recording) -> list[str]:
    """`layout_warnings` of a recording, by its first frames; none with fewer than `LEAST_FRAMES`."""
    sensor, frames = recording.sensor, min(recording.frames, CHECKED_FRAMES)
    if frames < LEAST_FRAMES:
        return []
    return layout_warnings(sensor, aligned_window(recording.read(0, frames), sensor, 0, 0, frames).rate(fill=True))
