"""From pictures to the light on a sensor: linear intensity, scaled and cropped to the sensor's size."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import Image, Intrinsics, Mosaic
from spiked.simulate.pictures.reading import Stored
from spiked.simulate.spans import Span
from spiked.simulate.view import LUMINANCE

_LONGEST = 4096
"""Frames of a span at most; bounds memory between pictures that are far apart."""
_TOGETHER = 1e-6
"""Frames within which a picture counts as taken at the boundary of two frames."""


@dataclass(frozen=True)
class Transfer:
    """How the values of a picture follow from light: the sRGB curve, or a power."""

    gamma: float | None
    """The exponent; None: sRGB."""

    @classmethod
    def parse(cls, text: str) -> "Transfer":
        """From `srgb`, `linear` or an exponent such as `2.2`. Raises ConfigurationError."""
        if text in ("srgb", "linear"):
            return cls(None if text == "srgb" else 1.0)
        try:
            gamma = float(text)
        except ValueError:
            gamma = np.nan
        if not 0.1 <= gamma <= 10:
            raise ConfigurationError(f"--gamma {text!r}: write srgb, linear, or an exponent from 0.1 to 10 such as 2.2")
        return cls(gamma)

    def __str__(self) -> str:
        return "sRGB" if self.gamma is None else "linear" if self.gamma == 1 else f"gamma {self.gamma:g}"

    def linear(self, picture: Stored) -> Image:
        """The light of a picture's values [H, W] or [H, W, 3]; 1 is white."""
        return np.asarray(self._tables[picture.dtype.itemsize - 1][picture])

    @cached_property
    def _tables(self) -> tuple[Image, Image]:
        """Light of each value of 8 and of 16 bits."""
        return self._of(np.linspace(0, 1, 1 << 8)), self._of(np.linspace(0, 1, 1 << 16))

    def _of(self, values: NDArray[np.float64]) -> Image:
        if self.gamma is not None:
            return (values**self.gamma).astype(np.float32)
        # IEC 61966-2-1
        return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


@dataclass(frozen=True)
class Framing:
    """Pictures scaled to cover a sensor, their middle cut out."""

    picture: tuple[int, int]
    """Width and height of the pictures."""
    scaled: tuple[int, int]
    """Width and height after scaling."""
    width: int
    height: int

    @classmethod
    def of(cls, picture: tuple[int, int], width: int | None, height: int | None) -> "Framing":
        """width, height: of the sensor. With one of them the other keeps the shape; without both, pictures keep their
        size. The width is rounded down to a multiple of 8. Raises ConfigurationError."""
        across, down = picture
        if width is None and height is None:
            width, height = across - across % 8, down
        elif width is None and height is not None:
            width = round(across * height / down)
            width -= width % 8
        elif height is None and width is not None:
            height = round(down * width / across)
        assert width is not None and height is not None
        if width < 8 or height < 1:
            raise ConfigurationError(f"pictures of {across}x{down} are too small: a sensor has 8 pixels in a row")
        factor = max(width / across, height / down)
        same = factor <= 1 and (across - width < 8 and across >= width) and down == height
        scaled = picture if same else (max(round(across * factor), width), max(round(down * factor), height))
        return cls(picture, scaled, width, height)

    @property
    def _corner(self) -> tuple[int, int]:
        return (self.scaled[0] - self.width) // 2, (self.scaled[1] - self.height) // 2

    def __call__(self, light: Image) -> Image:
        """The light [h, w] or [h, w, 3] on the sensor [H, W] or [H, W, 3]; pixels take the mean of what they cover."""
        if self.scaled != self.picture:
            smaller = self.scaled[0] < self.picture[0]
            light = cv2.resize(light, self.scaled, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
        left, top = self._corner
        return np.ascontiguousarray(light[top : top + self.height, left : left + self.width])

    def intrinsics(self, of_picture: Intrinsics) -> Intrinsics:
        """The sensor's, from those of the pictures."""
        x, y = self.scaled[0] / self.picture[0], self.scaled[1] / self.picture[1]
        left, top = self._corner
        k = of_picture
        return replace(k, fx=k.fx * x, fy=k.fy * y, cx=k.cx * x - left, cy=k.cy * y - top)

    def __str__(self) -> str:
        told = f"{self.picture[0]}x{self.picture[1]} pixels"
        if self.scaled != self.picture:
            told += f", scaled by {self.scaled[0] / self.picture[0]:.4g}"
        if self.scaled != (self.width, self.height):
            told += f", the middle {self.width}x{self.height} of {self.scaled[0]}x{self.scaled[1]} cut out"
        return told


@dataclass(frozen=True)
class Node:
    """The light on the sensor at one moment."""

    frame: float
    """The moment, in frames of the recording."""
    light: Image
    """Linear, 1 is white: grey [H, W], or colours [H, W, 3]."""


@dataclass(frozen=True)
class Sites:
    """What the sites of a sensor see of light."""

    mosaic: Mosaic | None
    gain: float
    """Expected spikes a frame of white."""

    def light(self, light: Image) -> Image:
        """As the sensor needs it: grey [H, W] without a mosaic, with one colours [H, W, 3]."""
        if self.mosaic is None:
            return np.asarray(light @ LUMINANCE if light.ndim == 3 else light, np.float32)
        return np.asarray(light if light.ndim == 3 else np.repeat(light[..., None], 3, 2), np.float32)

    def radiance(self, light: Image) -> Image:
        """Expected spikes a frame [H, W] of light [H, W], on a mosaic [H, W, 3]."""
        if self.mosaic is not None:
            sites = self.mosaic.channels(*light.shape[:2])[..., None].astype(np.int64)
            light = np.take_along_axis(light, sites, 2)[..., 0]
        return np.ascontiguousarray(self.gain * light, np.float32)


def spans_between(nodes: Iterator[Node], sites: Sites) -> Iterator[Span]:
    """Frames of light that runs linearly from node to node; a frame around a node gets the exact mean of its parts.

    The first node is the beginning of frame 0. The last frame is the last whole one before the last node.
    """
    before = next(nodes)
    first = sites.radiance(before.light)
    begin = before.frame
    parts: list[Image] = []
    done = 0  # frames that are complete
    for after in nodes:
        last, end = sites.radiance(after.light), after.frame
        # What is missing to a frame that began before this pair of nodes.
        if begin > done + _TOGETHER:
            stop = min(end, done + 1.0)
            parts.append(_mean(first, last, (begin + stop) / 2, before.frame, end) * np.float32(stop - begin))
            if end < done + 1 - _TOGETHER:
                before, first, begin = after, last, end
                continue
            mean = np.asarray(np.sum(parts, 0, dtype=np.float32))
            yield Span(mean, mean, np.zeros(1, np.float32))
            done, begin, parts = done + 1, stop, []
        whole = int(end + _TOGETHER) - done
        for start in range(done, done + whole, _LONGEST):
            middles = np.arange(start, min(start + _LONGEST, done + whole)) + 0.5
            yield Span(first, last, ((middles - before.frame) / (end - before.frame)).astype(np.float32))
        done += whole
        parts = []
        if end > done + _TOGETHER:
            parts = [_mean(first, last, (done + end) / 2, before.frame, end) * np.float32(end - done)]
        before, first, begin = after, last, end


def _mean(first: Image, last: Image, at: float, begin: float, end: float) -> Image:
    """The light at a moment between two nodes."""
    return np.asarray(first + np.float32((at - begin) / (end - begin)) * (last - first))
