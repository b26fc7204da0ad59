"""Scores a trajectory and its renders against the truth: ATE, RPE, coverage, PSNR, SSIM, LPIPS.

Trajectories are camera-to-world rotations [n, 3, 3] and centres [n, 3] of the same frames. An estimate's length unit
and world frame are its own, so the truth is aligned by a similarity first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.pose import exp_so3, log_so3
from spiked.trajectory import Trajectory

__all__ = [
    "PoseErrors",
    "Similarity",
    "TrajectoryScore",
    "ViewScore",
    "best_gain",
    "pose_errors",
    "psnr",
    "refine_pose",
    "score_trajectory",
    "score_views",
    "similarity_of_poses",
    "similarity_of_trajectories",
    "ssim",
    "umeyama",
]

Array = NDArray[np.float64]
Distance = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
"""Of two pictures of one size with values in [0, 1]: `spiked.lpips.Lpips` is one."""
Render = Callable[[Array, Array], NDArray[np.float32]]
"""A picture [H, W] or [H, W, 3] from a camera-to-world rotation [3, 3] and centre [3]."""

RPE_FRAMES = 32
"""Frames between the two poses of a relative pose error."""

MATCH_FRAMES = 0.6
"""A pose belongs to a frame if their times lie less than this many frames apart."""

_UNIT_POSES = 24
"""Poses, evenly spaced, of the ATE for paths of norm 1."""
MIN_SCORED_FRAMES = 48
"""Least number of frames with a pose: 1.5 times `RPE_FRAMES`, so that relative errors have at least 16 pairs."""

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows of the first and the second poses."""
Poses = tuple[Array, Array]
"""Camera-to-world rotations [n, 3, 3] and centres [n, 3]."""


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Array  # [3, 3]
    translation: Array  # [3]

    def points(self, points: Array) -> Array:
        """Transform points [..., 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def poses(self, rotations: Array, centres: Array) -> tuple[Array, Array]:
        """Transform camera-to-world poses [..., 3, 3], [..., 3]."""
        return self.rotation @ rotations, self.points(centres)


@dataclass(frozen=True)
class PoseErrors:
    """Errors of a trajectory after the best similarity; zero is perfect."""

    ate_percent: float
    """Root mean square distance of the centres, in % of the truth's RMS radius."""
    ate_unit: float
    """The same for 24 poses after both paths are centred and scaled to unit Frobenius norm (the convention of the
    CF-3DGS and InstantSplat tables; a camera that never moves scores 0.204)."""
    rpe_r_deg: float
    """Mean angle between true and estimated rotation over 32 frames, in degrees."""
    rpe_t_percent: float
    """Mean difference between true and estimated translation over 32 frames, in % of the truth's RMS radius."""
    rpe_r_unit_deg: float
    """Mean angle between true and estimated rotation from each of the 24 poses of `ate_unit` to the next, in degrees
    (the convention of the CF-3DGS and InstantSplat tables)."""
    rpe_t_unit: float
    """The same of the translation, in hundredths of the unit of `ate_unit`, as those tables print it."""


@dataclass(frozen=True)
class TrajectoryScore:
    """Coverage of the true frames, and errors of the poses found."""

    coverage: float
    """Share of the true frames that have an estimated pose."""
    errors: PoseErrors | None
    """None if fewer than `MIN_SCORED_FRAMES` frames have a pose."""


@dataclass(frozen=True)
class ViewScore:
    """PSNR and SSIM of held-out views, values in [0, 1] after one gain for all."""

    psnr_db: list[float]
    ssim: list[float]
    gain: float
    lpips: list[float] | None = None
    """Perceptual distance of each view, 0 for equal ones; None where it was not asked for."""
    shown: list[NDArray[np.float32]] = field(default_factory=list, repr=False, compare=False)
    """The renders that were compared, after the gain, in [0, 1]."""

    @property
    def mean_psnr_db(self) -> float:
        """Mean over the views of their PSNR in dB."""
        return float(np.mean(self.psnr_db))

    @property
    def mean_ssim(self) -> float:
        """Mean over the views of their SSIM."""
        return float(np.mean(self.ssim))

    @property
    def mean_lpips(self) -> float | None:
        """Mean over the views of their LPIPS, None without."""
        return None if self.lpips is None else float(np.mean(self.lpips))


def umeyama(*, source: Array, target: Array) -> Similarity:
    """The least-squares similarity from points `source` [n, 3] to `target` [n, 3].

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
    """
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    spread = float((a**2).sum())
    scale = float((singular * signs).sum() / spread) if spread > 0 else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def similarity_of_poses(*, truth: Poses, estimate: Poses) -> Similarity:
    """The similarity from the truth's world to the estimate's, its rotation from the orientations.

    Each argument is camera-to-world rotations [n, 3, 3] and centres [n, 3]. Positions alone do not determine the
    rotation about a straight path; orientations do. The rotation is the chordal mean of the relative rotations; scale
    and translation are least squares.
    """
    (truth_rotations, truth_centres), (rotations, centres) = truth, estimate
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", rotations, truth_rotations))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    turned = truth_centres @ rotation.T
    g, e = turned - turned.mean(0), centres - centres.mean(0)
    spread = float((g**2).sum())
    scale = float((g * e).sum() / spread) if spread > 0 else 1.0
    return Similarity(scale, rotation, centres.mean(0) - scale * turned.mean(0))


def pose_errors(*, truth: Poses, estimate: Poses, frames: NDArray[np.integer] | None = None) -> PoseErrors:
    """Errors of an estimate [n] against the truth [n], n >= 2, of increasing `frames` [n], by default without holes.

    Raises ConfigurationError for shapes that do not fit.
    """
    (truth_rotations, truth_centres), (rotations, centres) = truth, estimate
    n = len(truth_centres)
    if n < 2 or any(len(array) != n for array in (truth_rotations, rotations, centres)):
        raise ConfigurationError(
            f"pose errors need the same two or more frames on both sides, got {n} and {len(centres)}"
        )
    radius = float(np.sqrt(((truth_centres - truth_centres.mean(0)) ** 2).sum(1).mean()))
    if radius == 0:
        raise ConfigurationError("the true camera never moves, so errors relative to the size of its path mean nothing")
    fit = umeyama(source=centres, target=truth_centres)
    ate = _rms(fit.points(centres) - truth_centres)
    pairs = _pairs(np.arange(n) if frames is None else np.asarray(frames))
    turn, way = _relative(truth_rotations, truth_centres, pairs)
    turn_est, way_est = _relative(rotations, fit.scale * centres, pairs)
    unit = _unit_errors(truth, estimate)
    return PoseErrors(
        ate_percent=100 * ate / radius,
        ate_unit=unit[0],
        rpe_r_deg=_mean_angle_deg(turn, turn_est),
        rpe_t_percent=float(100 * np.linalg.norm(way_est - way, axis=1).mean() / radius),
        rpe_r_unit_deg=unit[1],
        rpe_t_unit=unit[2],
    )


def score_trajectory(*, truth: Trajectory, estimate: Trajectory, frame_rate_hz: float) -> TrajectoryScore:
    """Match an estimate to the truth by time stamp and score it."""
    j = estimate.nearest(truth.times_s, MATCH_FRAMES / frame_rate_hz)
    found = j >= 0
    coverage = float(found.mean())
    if found.sum() < MIN_SCORED_FRAMES:
        return TrajectoryScore(coverage, None)
    rows = j[found]
    errors = pose_errors(
        truth=(truth.rotations[found], truth.centres[found]),
        estimate=(estimate.rotations[rows], estimate.centres[rows]),
        frames=np.flatnonzero(found),
    )
    return TrajectoryScore(coverage, errors)


def similarity_of_trajectories(*, truth: Trajectory, estimate: Trajectory, frame_rate_hz: float) -> Similarity:
    """`similarity_of_poses` of the frames that both have.

    Raises ConfigurationError where they have fewer than two frames in common.
    """
    j = estimate.nearest(truth.times_s, MATCH_FRAMES / frame_rate_hz)
    found = j >= 0
    if found.sum() < 2:
        raise ConfigurationError("estimate and truth have fewer than two frames in common; do their time stamps agree?")
    rows = j[found]
    return similarity_of_poses(
        truth=(truth.rotations[found], truth.centres[found]),
        estimate=(estimate.rotations[rows], estimate.centres[rows]),
    )


def psnr(image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Peak signal-to-noise ratio in dB of values in [0, 1]; equal images give 120."""
    error = np.asarray(image, np.float64) - np.asarray(truth, np.float64)
    return float(10 * np.log10(1 / max(float((error**2).mean()), 1e-12)))


def ssim(image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Mean structural similarity of values in [0, 1], Gaussian window of sigma 1.5 px over 11 x 11 (Wang et al.
    2004)."""
    a, b = np.asarray(image, np.float64), np.asarray(truth, np.float64)

    def blur(x: Array) -> Array:
        return np.asarray(cv2.GaussianBlur(x, (11, 11), 1.5, borderType=cv2.BORDER_REFLECT), np.float64)

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b, cov = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2, blur(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    likeness = (2 * mean_a * mean_b + c1) * (2 * cov + c2) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    return float(likeness.mean())


def best_gain(images: Sequence[NDArray[np.floating]], *, truths: Sequence[NDArray[np.floating]]) -> float:
    """Least-squares gain that fits all images, [h, w] or [h, w, 3], to truths of the same shapes."""
    pairs = [(np.asarray(i, np.float64), np.asarray(t, np.float64)) for i, t in zip(images, truths, strict=True)]
    return float(sum((i * t).sum() for i, t in pairs) / max(float(sum((i * i).sum() for i, _ in pairs)), 1e-12))


def refine_pose(
    render: Render,
    pose: tuple[Array, Array],
    *,
    truth: NDArray[np.float32],
    gain: float,
    length: float,
    steps: int = 8,
) -> tuple[Array, Array]:
    """The pose whose render is nearest to `truth`, with a fixed scene: robust Gauss-Newton with a numeric Jacobian.

    pose: rotation [3, 3] and centre [3] to start from; length: a typical depth in the scene's unit, which sets the
    steps.
    """
    best, least = pose, np.inf
    small = np.array([1e-3] * 3 + [1e-3 * length] * 3)
    for _ in range(steps):
        residual = (gain * render(*pose) - truth).ravel().astype(np.float64)
        cost = float(residual @ residual)
        if cost >= 0.999 * least:
            return pose if cost < least else best
        best, least = pose, cost
        moved = (gain * render(*_moved(pose, step)) for step in np.diag(small))
        jacobian = np.stack([((m - truth).ravel() - residual) for m in moved], 1) / small
        weights = 1 / (1 + (residual / 0.1) ** 2)
        normal = jacobian.T @ (jacobian * weights[:, None])
        damped = normal + 1e-6 * np.diag(np.diag(normal)) + 1e-12 * np.eye(6)
        pose = _moved(pose, -np.linalg.solve(damped, jacobian.T @ (weights * residual)))
    return best


def score_views(
    render: Render,
    *,
    poses: Sequence[tuple[Array, Array]],
    truths: Sequence[NDArray[np.float32]],
    length: float,
    refine: bool = True,
    perceptual: Distance | None = None,
) -> ViewScore:
    """Score renders at held-out poses, given in the scene's frame, against images in [0, 1].

    With `refine`, each pose is first refined on its image, so that errors of the similarity do not count. `perceptual`
    gives `ViewScore.lpips`.
    """
    at = list(poses)
    gain = best_gain([render(*pose) for pose in at], truths=truths)
    if refine:
        at = [
            refine_pose(render, pose, truth=truth, gain=gain, length=length)
            for pose, truth in zip(at, truths, strict=True)
        ]
    images = [render(*pose) for pose in at]
    gain = best_gain(images, truths=truths)
    shown = [np.clip(gain * image, 0, 1) for image in images]
    pairs = list(zip(shown, truths, strict=True))
    return ViewScore(
        psnr_db=[psnr(i, t) for i, t in pairs],
        ssim=[ssim(i, t) for i, t in pairs],
        gain=gain,
        lpips=None if perceptual is None else [perceptual(i, t) for i, t in pairs],
        shown=shown,
    )


def _rms(differences: Array) -> float:
    return float(np.sqrt((differences**2).sum(1).mean()))


def _pairs(frames: NDArray[np.integer]) -> Pairs:
    """Rows of poses and of the first ones that are `RPE_FRAMES` later or more; pairs across a hole are left out.

    Poses that are all further apart, or fewer, are paired with their neighbours.
    """
    apart = min(RPE_FRAMES, int(frames[-1] - frames[0]))
    later = np.searchsorted(frames, frames + apart)
    first = np.flatnonzero(later < len(frames))
    second = later[first]
    near = frames[second] - frames[first] <= 1.5 * apart
    return (first[near], second[near]) if near.any() else _neighbours(len(frames))


def _neighbours(count: int) -> Pairs:
    return np.arange(count - 1), np.arange(1, count)


def _relative(rotations: Array, centres: Array, pairs: Pairs) -> tuple[Array, Array]:
    """Rotation [m, 3, 3] and translation [m, 3] from the first pose of each pair to the second, in the first camera."""
    first, second = pairs
    back = rotations[first].swapaxes(-1, -2)
    return back @ rotations[second], np.einsum("nij,nj->ni", back, centres[second] - centres[first])


def _mean_angle_deg(turns: Array, others: Array) -> float:
    """Mean angle between rotations [n, 3, 3] and others, in degrees."""
    return float(np.degrees(np.linalg.norm(log_so3(turns.swapaxes(-1, -2) @ others), axis=1)).mean())


def _unit_errors(truth: Poses, estimate: Poses) -> tuple[float, float, float]:
    """`ate_unit`, `rpe_r_unit_deg` and `rpe_t_unit` of `PoseErrors`."""
    rows = np.linspace(0, len(truth[1]) - 1, _UNIT_POSES).round().astype(int)
    (truth_rotations, truth_centres), (rotations, centres) = ((r[rows], c[rows]) for r, c in (truth, estimate))

    def unit(x: Array) -> Array:
        centred = x - x.mean(0)
        return np.asarray(centred / max(float(np.linalg.norm(centred)), 1e-12))

    a, b = unit(centres), unit(truth_centres)
    fit = umeyama(source=a, target=b)
    turn, way = _relative(truth_rotations, b, _neighbours(len(rows)))
    turn_est, way_est = _relative(rotations, fit.scale * a, _neighbours(len(rows)))
    way_error = float(100 * np.linalg.norm(way_est - way, axis=1).mean())
    return _rms(fit.points(a) - b), _mean_angle_deg(turn, turn_est), way_error


def _moved(pose: tuple[Array, Array], step: Array) -> tuple[Array, Array]:
    """The pose rotated by step[:3] and translated by step[3:], both in camera axes."""
    rotation, centre = pose
    return rotation @ exp_so3(step[:3]), centre + rotation @ step[3:]
