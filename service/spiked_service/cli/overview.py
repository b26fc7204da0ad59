"""The overview picture of a reconstruction: path, observed and rendered views, and loss over time. After a failure:
the observed views and the reason."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from spiked.recon import Reconstructor, Sample
from spiked.trajectory import Trajectory

_SAMPLES = 4
"""Views shown."""
_WIDTH_IN = 14.0
"""Width of the figure, inches."""
_PATHS_IN = 4.3
"""Height of the plots of the path, inches."""
_INK = "#1d2330"
_PATH = "viridis"
_LINE = 120
"""Characters of the title in a line."""


def draw_overview(reconstructor: Reconstructor, title: str, curve: Sequence[tuple[float, float]], path: Path) -> None:
    """Write the picture as PNG; `curve` is the loss over seconds of work."""
    samples, status, failure = reconstructor.samples(_SAMPLES), reconstructor.status(), reconstructor.failure
    outcome = f"{status.splats} splats, {status.state}" if failure is None else f"failed\n{fill(failure, _LINE)}"
    paths_in = _PATHS_IN if failure is None else 0.0
    figure = Figure(figsize=(_WIDTH_IN, paths_in + _samples_height(samples)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{title}   ·   {status.frames} frames, {outcome}", color=_INK)
    if failure is None:
        heights = (paths_in, _samples_height(samples))
        above, pictures = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
        _draw_reconstruction(above, reconstructor.trajectory(), curve)
    else:
        pictures = figure.subfigures(1, 1)
    if samples:
        grid = pictures.subplots(_rows(samples), len(samples), squeeze=False)
        _draw_samples(grid, samples, reconstructor.white if _rows(samples) > 1 else _white(samples))
    else:
        pictures.text(0.5, 0.5, "no frames", ha="center", color=_INK)
    figure.savefig(path, dpi=110)


def _draw_reconstruction(above: SubFigure, trajectory: Trajectory, curve: Sequence[tuple[float, float]]) -> None:
    top, side, fit = above.subplots(1, 3)
    _draw_path(top, trajectory, (0, 2), ("x, right", "z, forward"), "path from above")
    _draw_path(side, trajectory, (2, 1), ("z, forward", "y, down"), "path from the side")
    side.invert_yaxis()
    _draw_fit(fit, curve)


def _samples_height(samples: list[Sample]) -> float:
    """Inches for rows of pictures that fill the width."""
    if not samples:
        return 1.0
    rows, columns = samples[0].observed.shape[:2]
    return float(_rows(samples) * (0.95 * _WIDTH_IN / len(samples)) * rows / columns + 0.8)


def _rows(samples: list[Sample]) -> int:
    """Observed pictures, and rendered ones below them where there is a map."""
    return 1 if samples[0].rendered is None else 2


def _white(samples: list[Sample]) -> float:
    """What is shown as white where no map says it."""
    return max(float(np.percentile([sample.observed for sample in samples], 99.5)), 1e-6)


def _draw_path(
    axes: Axes, trajectory: Trajectory, columns: tuple[int, int], labels: tuple[str, str], title: str
) -> None:
    axes.set_title(title, fontsize=10, color=_INK)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    axes.grid(color="#e6e8ee", linewidth=0.6)
    if len(trajectory) == 0:
        axes.text(0.5, 0.5, "no pose", transform=axes.transAxes, ha="center")
        return
    a, b = columns
    at = trajectory.centres
    axes.set_aspect("equal", adjustable="datalim")
    axes.scatter(at[:, a], at[:, b], c=trajectory.times_s, cmap=_PATH, s=4, zorder=3)
    every = np.linspace(0, len(at) - 1, 14).round().astype(int)
    forward = trajectory.rotations[every][:, :, 2]
    length = 0.12 * max(float(np.ptp(at[:, a])), float(np.ptp(at[:, b])), 1e-9)
    heads = at[every] + length * forward
    axes.plot(
        np.stack([at[every, a], heads[:, a]]), np.stack([at[every, b], heads[:, b]]), color=_INK, lw=0.8, alpha=0.6
    )
    axes.plot(*at[0, [a, b]], "o", color="#2a9d4a", ms=7, label=f"{trajectory.times_s[0] * 1e3:.1f} ms")
    axes.plot(*at[-1, [a, b]], "s", color="#d1495b", ms=7, label=f"{trajectory.times_s[-1] * 1e3:.1f} ms")
    axes.legend(fontsize=8, loc="best", framealpha=0.8)


def _draw_fit(axes: Axes, curve: Sequence[tuple[float, float]]) -> None:
    axes.set_title("loss of the views", fontsize=10, color=_INK)
    axes.set_xlabel("seconds of work")
    axes.set_ylabel("mean squared error, white = 1")
    axes.grid(color="#e6e8ee", linewidth=0.6, which="both")
    if curve:
        seconds, losses = np.array(curve).T
        axes.semilogy(seconds, losses, color="#3a6ea5", lw=1.8)


def _draw_samples(grid: NDArray[np.object_], samples: list[Sample], white: float) -> None:
    for column, sample in enumerate(samples):
        for row, (name, image) in enumerate((("observed", sample.observed), ("rendered", sample.rendered))):
            if image is None:
                continue
            axes: Axes = grid[row, column]
            shown = np.clip(image / white, 0, 1)
            axes.imshow(shown[..., 0] if shown.shape[2] == 1 else shown, cmap="gray", vmin=0, vmax=1)
            axes.set_xticks([])
            axes.set_yticks([])
            if column == 0:
                axes.set_ylabel(name, color=_INK)
        grid[0, column].set_title(f"{sample.time_s * 1e3:.2f} ms", fontsize=9, color=_INK)
