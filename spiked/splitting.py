"""Splats that are too large, replaced by smaller ones that together show the same.

A renderer draws a splat by its shape at its middle (the affine approximation of Zwicker et al., "EWA volume splatting",
2001), so that a huge one is a flat ellipse at one depth wherever it reaches. It is divided there: in the view that it
fills most, into a grid of pieces at that depth. A Gaussian of variance v is the sum of those of variance c, spread with
the variance v - c. What hides along a ray adds up in -log(1 - opacity), which the pieces share. Gradient steps towards
the pictures of the scene before, along the path and beside it, correct the rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import quaternion, rotation_of
from spiked.recon.statistics import evenly
from spiked.render import Camera, RenderedImage
from spiked.render.cpu import Rasteriser
from spiked.render.optimiser import Adam
from spiked.scene import Scene
from spiked.trajectory import Trajectory

__all__ = ["Split", "split_large"]

Doubles = NDArray[np.float64]

VIEWS = 64
"""Views along the path in which large splats are looked for."""
PIECE = 0.8
"""Standard deviation of a piece over the largest that is allowed, and spacing of the pieces in that deviation: the sum
of Gaussians that far apart is even to 1e-8."""
REACH = 3.5
"""Standard deviations of a splat within which it is kept: beyond is 0.2 % of its opacity."""
FAINT = 1 / 255
"""Opacity below which renderers draw nothing."""
BUDGET = 0.25
"""Most pieces over the splats of the scene, and ..."""
LEAST_BUDGET = 10_000
"""... the number that is always allowed. What would be more stays as it is: made smaller, it would leave a hole."""
STEPS = 400
"""Gradient steps, every second one on the path itself (decision 46)."""
PIXELS = 130_000
"""Most pixels of the pictures that are fitted; larger ones are rendered smaller."""
ASIDE = 0.15
"""Largest distance of a fitted view from the path to each side, over the median depth of the first view."""
RATES = 6e-4, 8e-3, 3e-2, 2.4e-2
"""Learning rates at the begin of means (over that depth), quaternions, logarithms of scales and opacity logits: 0.3 of
those that a map begins with. They fall to a tenth."""
BACKGROUND = 0.5
"""Largest brightness of the random background of fitted views, over the white of the first one: pieces have to be as
opaque as what they replace."""
HUBER = 0.1
"""Errors over white beyond which the loss is linear."""
WIDER = 1.1
"""Size of the pictures in which pieces have to be seen, over those of the camera, and ..."""
LEAST_PX = 0.05
"""... the pixels that a piece has to fill in one of them, from the path or as far aside of it as fitted views are. A
splat that reaches far out of all views would else become a wall around the scene."""


@dataclass(frozen=True)
class Split:
    """A scene without large splats, and what was done."""

    scene: Scene
    split: int
    """Splats that were replaced by several."""
    shrunk: int
    """Splats that were made smaller: no view sees them."""
    left: int
    """Splats that stay as they are: they would be too many, as the sky far behind a small scene would."""


def split_large(
    scene: Scene,
    largest: float,
    path: Trajectory,
    camera: Camera,
    reach: float,
    progress: Callable[[float], None] | None = None,
) -> Split:
    """Replace splats of a standard deviation above `largest`.

    What they show within `reach` of the scene's median stays, seen from `path` by `camera`, and behind it what is in
    the same directions; both lengths are in the scene's unit.
    """
    large = np.flatnonzero(np.exp(scene.log_scales).max(axis=1) > largest)
    if not len(large) or largest <= 0:
        return Split(scene, 0, 0, 0)
    rasteriser, shared = _rasteriser(camera), _Grid(PIECE * largest, largest, np.median(scene.means, axis=0), reach)
    filled, rows = _fullest(scene, large, path, rasteriser)
    budget, replaced, pieces = max(int(BUDGET * len(scene)), LEAST_BUDGET), [], []
    for n in np.argsort(-filled):
        if filled[n] <= 0:
            break
        found = shared.pieces(scene, int(large[n]), path.rotations[rows[n]], path.centres[rows[n]], budget)
        if len(found):
            budget -= len(found)
            replaced.append(large[n])
            pieces.append(found)
    unseen = large[filled <= 0]
    scales = scene.log_scales.copy()
    scales[unseen] = np.minimum(scales[unseen], np.float32(np.log(largest)))
    made = replace(scene, log_scales=scales).select(np.setdiff1d(np.arange(len(scene)), replaced))
    first = len(made)
    for some in pieces:
        made = made.join(some)
    if pieces:
        start = rasteriser.forward(scene.seen_from(path.centres[0]), path.rotations[:1], path.centres[:1])
        depth = _depth(start)
        white = max(float(np.percentile(start.values, 99.5)), 1e-9)
        _fit(made, first, scene, largest, path, rasteriser, depth, white, progress)
        made = _seen(made, first, path, camera, depth)
    return Split(made, len(replaced), len(unseen), len(large) - len(replaced) - len(unseen))


def _rasteriser(camera: Camera) -> Rasteriser:
    """For pictures of the camera, smaller if they are large."""
    factor = int(np.ceil(np.sqrt(camera.width * camera.height / PIXELS)))
    return Rasteriser(Camera(camera.intrinsics.scaled(1 / factor), camera.width // factor, camera.height // factor))


def _depth(view: RenderedImage) -> float:
    """Median depth of what is opaque in a view."""
    opaque = view.alpha > 0.5
    return float(np.median(view.depth[opaque])) if opaque.any() else 1.0


def _seen(made: Scene, first: int, path: Trajectory, camera: Camera, depth: float) -> Scene:
    """The scene without the splats from `first` on that no view sees, from the path or beside it."""
    rasteriser, wanted = _rasteriser(camera.wider(WIDER)), np.arange(first, len(made))
    around = ASIDE * depth * np.array([(0, 0), (-1, -1), (1, -1), (-1, 1), (1, 1)])
    rows = np.array(evenly(len(path), VIEWS))
    filled = np.zeros(len(wanted))
    for row, aside in zip(rows, np.resize(around, (len(rows), 2)), strict=True):
        centre = path.centres[row] + path.rotations[row][:, :2] @ aside
        image = rasteriser.forward(made, path.rotations[row][None], centre[None])
        filled = np.maximum(filled, rasteriser.backward(np.zeros_like(image.values)).contribution[wanted])
    return made.select(np.append(np.ones(first, bool), filled >= LEAST_PX))


def _fullest(
    scene: Scene, chosen: NDArray[np.int64], path: Trajectory, rasteriser: Rasteriser
) -> tuple[Doubles, NDArray[np.int64]]:
    """Pixels that the chosen splats [n] fill in the view where they fill most, and its row of the path."""
    filled, rows = np.zeros(len(chosen)), np.zeros(len(chosen), np.int64)
    for row in evenly(len(path), VIEWS):
        image = rasteriser.forward(scene, path.rotations[row][None], path.centres[row][None])
        here = rasteriser.backward(np.zeros_like(image.values)).contribution[chosen]
        rows[here > filled] = row
        filled = np.maximum(filled, here)
    return filled, rows


@dataclass(frozen=True)
class _Grid:
    """How splats are divided."""

    deviation: float
    """Of a piece, and the distance of two."""
    largest: float
    middle: Doubles
    reach: float

    def pieces(self, scene: Scene, n: int, rotation: Doubles, centre: Doubles, most: int) -> Scene:
        """The pieces of a splat, for a view from a pose, camera to world; none if they would be more than `most`."""
        own = rotation.T @ rotation_of(scene.quats[n])
        deviations = np.exp(scene.log_scales[n].astype(np.float64))
        mean = rotation.T @ (scene.means[n] - centre)
        # What a renderer sees of it: moving along a ray changes nothing.
        across = np.array([[1, 0, -mean[0] / mean[2]], [0, 1, -mean[1] / mean[2]]]) @ own * deviations
        axes, widths, _ = np.linalg.svd(across)
        towards = rotation.T @ (self.middle - centre)
        further = mean[2] / towards[2] if towards[2] > 0 else 1.0
        middle, reach = (further * towards - mean)[:2] @ axes, self.reach * max(1.0, further)
        spans = [self._span(widths[k], middle[k], reach) for k in (0, 1)]
        if np.prod([max(last - first, 0.0) for first, last in spans]) > most:
            return scene.select(np.zeros(0, np.int64))
        (u, u_share), (v, v_share) = (self._line(widths[k], *spans[k]) for k in (0, 1))
        at = np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)
        hides = -np.log1p(-np.minimum(scene.opacities[n] * np.outer(u_share, v_share).ravel(), 1 - 1e-6))
        opacities = 1 - np.exp(-hides / np.sqrt(2 * np.pi) ** int((widths > self.largest).sum()))
        at, opacities = at[opacities > FAINT], opacities[opacities > FAINT]
        turned = np.eye(3)
        turned[:2, :2], turned[2, 2] = axes, np.linalg.det(axes)
        depth = min(float(deviations.min()), self.deviation)
        sizes = np.append(np.where(widths > self.largest, self.deviation, widths), depth)
        means = mean + np.column_stack([at @ axes.T, np.zeros(len(at))])
        return replace(
            scene.select(np.full(len(at), n)),
            means=np.asarray(means @ rotation.T + centre, np.float32),
            quats=np.tile(np.asarray(quaternion(rotation @ turned), np.float32), (len(at), 1)),
            log_scales=np.tile(np.log(np.maximum(sizes, 1e-12)).astype(np.float32), (len(at), 1)),
            opacity_logits=np.log(opacities / (1 - opacities)).astype(np.float32),
        )

    def _span(self, width: float, middle: float, reach: float) -> tuple[float, float]:
        """Numbers of the first piece along an axis of a splat of that deviation, and of the one after the last."""
        if width <= self.largest:
            return 0.0, 1.0
        low, high = (REACH * sign * self._spread(width) for sign in (-1, 1))
        low, high = max(low, middle - reach), min(high, middle + reach)
        return float(np.floor(low / self.deviation)), float(np.ceil(high / self.deviation)) + 1

    def _line(self, width: float, first: float, last: float) -> tuple[Doubles, Doubles]:
        """Places of the pieces from the mean of the splat, and its share there."""
        places = self.deviation * np.arange(first, last)
        if width <= self.largest:
            return places, np.ones(len(places))
        return places, np.exp(-0.5 * (places / self._spread(width)) ** 2)

    def _spread(self, width: float) -> float:
        """Standard deviation of the places of the pieces."""
        return float(np.sqrt(width**2 - self.deviation**2))


def _fit(
    made: Scene,
    first: int,
    before: Scene,
    largest: float,
    path: Trajectory,
    rasteriser: Rasteriser,
    depth: float,
    white: float,
    progress: Callable[[float], None] | None,
) -> None:
    """Fit the splats from `first` on, in place, to pictures of the scene before."""
    rng, adam, most = np.random.default_rng(0), Adam(made.arrays()[:4], 0.9, 0.99), np.float32(np.log(largest))
    pieces = np.arange(len(made)) >= first
    for step in range(STEPS):
        row = int(rng.integers(len(path)))
        rotation = path.rotations[row]
        aside = ASIDE * depth * (step % 2)
        pose = rotation[None], (path.centres[row] + aside * rotation[:, :2] @ rng.uniform(-1, 1, 2))[None]
        background = float(rng.uniform(0, BACKGROUND)) * white
        wanted = rasteriser.forward(before.seen_from(pose[1][0]), *pose, background=background).values.copy()
        shown = rasteriser.forward(made.seen_from(pose[1][0]), *pose, background=background).values
        slope = np.clip((shown - wanted) / white, -HUBER, HUBER) / shown.size
        gradients = rasteriser.backward(np.asarray(slope, np.float32))
        means, *others = (0.1 ** (step / STEPS) * rate for rate in RATES)
        adam.step(
            made.arrays()[:4], gradients.arrays()[:4], (means * depth, *others), pieces & (gradients.radius_px > 0)
        )
        np.minimum(made.log_scales[first:], most, out=made.log_scales[first:])
        if progress is not None:
            progress((step + 1) / STEPS)
