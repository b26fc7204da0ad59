"""Plots as inline SVG without scripts: the style sheet of the page colours them, so that they follow its theme."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array

Points = NDArray[np.float64]

WIDTH, HEIGHT = 520, 210
"""Of a plot, in the units of its view box: about the pixels that it has on a page."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 22, 38
"""Margins with the labels."""
_BINS = 240
"""Most points of a curve: more than two of them share a pixel."""
_TIME_STEPS = 40
"""Pieces of a path that are coloured by their time."""
_TIME_COLOURS = np.array([[68, 110, 180], [36, 146, 172], [53, 183, 121], [144, 215, 67], [253, 231, 37]], np.float64)
"""RGB from the first to the last pose: about the upper part of the colour map viridis, which rises in lightness."""
_GAP_STEPS = 3.0
"""A longer pause between poses than so many times the usual one interrupts the line."""


@dataclass(frozen=True)
class Frame:
    """The area of a plot and the values at its edges."""

    x: tuple[float, float]
    y: tuple[float, float]

    def right(self, values: Points | float) -> Points:
        """Horizontal places of values of x."""
        low, high = self.x
        share = (np.asarray(values, np.float64) - low) / max(high - low, 1e-300)
        return np.asarray(_LEFT + share * (WIDTH - _LEFT - _RIGHT))

    def down(self, values: Points | float) -> Points:
        """Vertical places of values of y."""
        low, high = self.y
        share = (np.asarray(values, np.float64) - low) / max(high - low, 1e-300)
        return np.asarray(HEIGHT - _BOTTOM - share * (HEIGHT - _TOP - _BOTTOM))


def curve(x: Points, y: Points, labels: tuple[str, str], name: str, *, floor: float | None = None) -> str:
    """A line through the means of neighbours, on a band from their least to their greatest; NaN interrupts it."""
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return ""
    low, high = float(y[known].min()), float(y[known].max())
    low = low if floor is None else min(floor, low)
    frame = Frame((float(x[known].min()), float(x[known].max())), _padded(low, high, keep_low=floor is not None))
    middles, means, least, most = _binned(x[known], y[known])
    band = [*zip(frame.right(middles), frame.down(most), strict=True)]
    band += [*zip(frame.right(middles[::-1]), frame.down(least[::-1]), strict=True)]
    line = zip(frame.right(middles), frame.down(means), strict=True)
    drawn = f'<polygon class="band" points="{_points(band)}"/><polyline class="line" points="{_points(line)}"/>'
    return _plot(name, _axes(frame, labels) + drawn)


def histogram(values: Points, labels: tuple[str, str], name: str, bins: int = 40) -> str:
    """Counts of values from 0 to their 99th percentile; the last bar has those beyond."""
    known = values[np.isfinite(values)]
    if not len(known):
        return ""
    end = max(float(np.percentile(known, 99)), 1e-9)
    counts, edges = np.histogram(np.minimum(known, end), bins, (0.0, end))
    frame = Frame((0.0, end), (0.0, float(counts.max()) * 1.05))
    base = float(frame.down(0.0))
    drawn = []
    for count, left, right in zip(counts, frame.right(edges[:-1]), frame.right(edges[1:]), strict=True):
        top = float(frame.down(float(count)))
        drawn.append(
            f'<rect class="bar" x="{left + 0.5:.1f}" y="{top:.1f}" width="{max(right - left - 1, 0.5):.1f}" '
            f'height="{max(base - top, 0):.1f}"/>'
        )
    return _plot(name, _axes(frame, labels) + "".join(drawn))


def path(points: Points, times_s: Array, labels: tuple[str, str], name: str, *, down: bool = False) -> str:
    """A path [n, 2] seen along an axis, both axes to one scale, coloured by time; `down`: y grows downwards."""
    if not len(points):
        return ""
    size = WIDTH, 340
    low, high = points.min(0), points.max(0)
    middle, span = (low + high) / 2, max(float((high - low).max()), 1e-9)
    scale = min(
        (size[0] - 90) / max(float(high[0] - low[0]), span / 50),
        (size[1] - 90) / max(float(high[1] - low[1]), span / 50),
    )
    across = size[0] / 2 + (points[:, 0] - middle[0]) * scale
    sign = 1.0 if down else -1.0
    along = size[1] / 2 - 8 + sign * (points[:, 1] - middle[1]) * scale
    placed = np.column_stack([across, along])
    drawn = [_scale_bar(scale, size), *_timed_lines(placed, times_s)]
    drawn += [
        f'<circle class="begin" cx="{placed[0, 0]:.1f}" cy="{placed[0, 1]:.1f}" r="5"><title>begin</title></circle>',
        f'<rect class="end" x="{placed[-1, 0] - 4.5:.1f}" y="{placed[-1, 1] - 4.5:.1f}" width="9" height="9">'
        "<title>end</title></rect>",
        f'<text class="glass" x="{size[0] - 12}" y="{size[1] - 12}" text-anchor="end">{escape(labels[0])} →</text>',
        f'<text class="glass" x="12" y="20">{"↓" if down else "↑"} {escape(labels[1])}</text>',
    ]
    return _plot(name, "".join(drawn), size, "path")


def strip(begin_s: float, end_s: float, runs: Sequence[tuple[float, float, str]], name: str) -> str:
    """Runs (from, to, state) over time as one bar."""
    height, span = 26, max(end_s - begin_s, 1e-12)
    drawn = []
    for first, last, state in runs:
        left, right = ((time - begin_s) / span * WIDTH for time in (first, last))
        drawn.append(
            f'<rect class="state-{escape(state)}" x="{left:.2f}" y="0" width="{max(right - left, 0.8):.2f}" '
            f'height="{height}"><title>{escape(state)}, {first:.4f} to {last:.4f} s</title></rect>'
        )
    return _plot(name, "".join(drawn), (WIDTH, height), "strip", stretched=True)


def _timed_lines(placed: Points, times_s: Array) -> list[str]:
    """Polylines of the path, each in the colour of its time, broken where no pose is known."""
    pause = np.diff(times_s)
    usual = float(np.median(pause)) if len(pause) else 0.0
    broken = set((np.flatnonzero(pause > _GAP_STEPS * max(usual, 1e-12)) + 1).tolist())
    edges = sorted({*np.linspace(0, len(placed), _TIME_STEPS + 1).astype(int).tolist(), *broken})
    lines = []
    for begin, end in pairwise(edges):
        last = end if end >= len(placed) or end in broken else end + 1  # meets the next piece
        share = (begin + end) / 2 / len(placed)
        lines.append(
            f'<polyline fill="none" stroke="{_time_colour(share)}" stroke-width="2.5" stroke-linecap="round" '
            f'stroke-linejoin="round" points="{_points(placed[begin:last])}"/>'
        )
    return lines


def _time_colour(share: float) -> str:
    place = share * (len(_TIME_COLOURS) - 1)
    red, green, blue = (np.interp(place, np.arange(len(_TIME_COLOURS)), part) for part in _TIME_COLOURS.T)
    return f"#{round(red):02x}{round(green):02x}{round(blue):02x}"


def _scale_bar(scale: float, size: tuple[int, int]) -> str:
    length = _round_up(60 / scale)
    wide = length * scale
    y = size[1] - 16
    return (
        f'<path class="scale" d="M12 {y - 4}v8M12 {y}h{wide:.1f}m0 -4v8"/>'
        f'<text class="glass" x="{18 + wide:.1f}" y="{y + 4}">{length:g} units</text>'
    )


def _axes(frame: Frame, labels: tuple[str, str]) -> str:
    """Grid, numbers and names of both axes."""
    drawn = []
    for value in _ticks(*frame.y):
        y = float(frame.down(value))
        drawn.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>')
        drawn.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_number(value)}</text>')
    for value in _ticks(*frame.x, wanted=7):
        x = float(frame.right(value))
        drawn.append(f'<text x="{x:.1f}" y="{HEIGHT - _BOTTOM + 15}" text-anchor="middle">{_number(value)}</text>')
    drawn.append(f'<text x="{WIDTH - _RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{escape(labels[0])}</text>')
    drawn.append(f'<text x="{_LEFT}" y="12">{escape(labels[1])}</text>')
    return "".join(drawn)


def _plot(
    name: str, drawn: str, size: tuple[int, int] = (WIDTH, HEIGHT), kind: str = "plot", stretched: bool = False
) -> str:
    fit = ' preserveAspectRatio="none"' if stretched else ""
    return (
        f'<svg class="{kind}" viewBox="0 0 {size[0]} {size[1]}" role="img" aria-label="{escape(name)}"{fit}>'
        f"{drawn}</svg>"
    )


def _binned(x: Points, y: Points) -> tuple[Points, Points, Points, Points]:
    """Middles, means, least and greatest values of at most `_BINS` runs of neighbours."""
    starts = np.unique(np.linspace(0, len(x), min(_BINS, len(x)), endpoint=False).astype(int))
    sizes = np.diff([*starts, len(x)])
    means = np.add.reduceat(y, starts) / sizes
    return np.add.reduceat(x, starts) / sizes, means, np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)


def _padded(low: float, high: float, keep_low: bool) -> tuple[float, float]:
    pad = 0.06 * (high - low) or max(abs(high), 1.0) * 0.05
    return (low if keep_low else low - pad), high + pad


def _ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers within a range, at most about so many."""
    step = _round_up((high - low) / wanted)
    first = np.ceil(low / step - 1e-9)
    count = int(np.floor(high / step + 1e-9) - first) + 1
    return [float((first + k) * step) for k in range(max(count, 0))]


def _round_up(value: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is not smaller."""
    if not value > 0 or not np.isfinite(value):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(step for step in (1, 2, 5, 10) if step >= value / power * (1 - 1e-9)))


def _number(value: float) -> str:
    return f"{value:.6g}"


def _points(points: Iterable[tuple[float, float]] | Points) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
