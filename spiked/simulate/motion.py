"""Camera paths: a pose for every moment, for ever. Time is in frames (frame k lasts from k to k + 1), poses are
camera-to-world with OpenCV axes (x right, y down, z forward)."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spiked.errors import ConfigurationError
from spiked.pose import exp_so3, log_so3

Array = NDArray[np.float64]


class Motion(Protocol):
    """Anything that knows where the camera is."""

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """Rotations [n, 3, 3] and centres [n, 3] at the times `frames` [n], which may be fractions."""
        ...


class MotionKind(StrEnum):
    """The paths that `make_motion` knows."""

    HAND_SHAKE = "hand_shake"
    ARC = "arc"
    FORWARD = "forward"
    KINKED = "kinked"
    STAND_THEN_MOVE = "stand_then_move"
    ROTATION = "rotation"


@dataclass(frozen=True)
class Stage:
    """Where a path starts and what it should look like on the sensor."""

    centre: Array
    """Start of the path [3]."""
    target: Array
    """The point [3] that the camera looks at from there; its distance is the depth of the stated flow."""
    up: Array
    """Upward direction [3]."""
    focal_px: float
    flow_px: float = 0.12
    """Root mean square image motion that is aimed at, in pixels a frame."""
    parallax: float = 0.1
    """Path of the camera in 1,280 frames as a share of the depth."""

    def __post_init__(self) -> None:
        if not (self.focal_px > 0 and self.flow_px >= 0 and self.parallax >= 0 and self.depth > 0):
            raise ConfigurationError("a path needs a positive focal length and depth, and no negative flow or parallax")

    @property
    def depth(self) -> float:
        """Distance from the start to the target."""
        return float(np.linalg.norm(self.target - self.centre))

    @property
    def rotation(self) -> Array:
        """Orientation at the start [3, 3]."""
        return look_at(self.centre, self.target, self.up)


def look_at(centre: ArrayLike, target: ArrayLike, up: ArrayLike) -> Array:
    """The rotation [3, 3] of a camera at `centre` that looks at `target` with `up` upwards in the image.

    All three may be [..., 3]; the result is [..., 3, 3].
    """
    forward = np.asarray(target, np.float64) - np.asarray(centre, np.float64)
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, np.asarray(up, np.float64))
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], -1)


@dataclass(frozen=True)
class Harmonics:
    """A smooth random function of time, zero at time 0: a sum of sines whose periods never meet again."""

    amplitudes: Array  # [m, d]
    turns: Array  # [m, d] radians a frame
    phases: Array  # [m, d] radians

    @classmethod
    def draw(cls, rng: np.random.Generator, speed: ArrayLike, periods: tuple[float, float], terms: int) -> "Harmonics":
        """`speed` [d]: root mean square change a frame of each component; periods in frames, spread log-uniformly."""
        speed = np.asarray(speed, np.float64)
        edges = np.linspace(np.log(periods[0]), np.log(periods[1]), terms + 1)
        spread = rng.uniform(edges[:-1, None], edges[1:, None], (terms, len(speed)))
        turns = 2 * np.pi / np.exp(spread)
        share = rng.uniform(0.5, 1.5, turns.shape)
        share /= np.sqrt((share**2).sum(0))
        return cls(np.sqrt(2) * speed * share / turns, turns, rng.uniform(0, 2 * np.pi, turns.shape))

    def at(self, times: Array) -> Array:
        """Values [n, d] at times [n]."""
        angle = times[:, None, None] * self.turns + self.phases
        return np.asarray(np.einsum("nmd,md->nd", np.sin(angle) - np.sin(self.phases), self.amplitudes))


@dataclass(frozen=True)
class HandShake:
    """A hand-held camera: slow sway of position and orientation, and a tremor of a tenth of their speed."""

    stage: Stage
    position: tuple[Harmonics, ...]
    orientation: tuple[Harmonics, ...]

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        times = np.atleast_1d(np.asarray(frames, np.float64))
        base = self.stage.rotation
        turn = sum((part.at(times) for part in self.orientation), np.zeros((len(times), 3)))
        shift = sum((part.at(times) for part in self.position), np.zeros((len(times), 3)))
        return base @ exp_so3(turn), self.stage.centre + shift @ base.T


def hand_shake(stage: Stage, seed: int = 0) -> HandShake:
    """Hand-held motion: the path of 1,280 frames is about `parallax` of the depth, the rest of the flow is rotation."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x407]))
    step = stage.parallax * stage.depth / 1280
    swing = max(stage.flow_px / stage.focal_px - 0.5 * step / stage.depth, 0.0)
    sideways, tilting = np.array([0.75, 0.55, 0.36]) * step, np.array([0.55, 0.75, 0.36]) * swing
    slow, tremor = (2200.0, 5000.0), (180.0, 420.0)
    position = (Harmonics.draw(rng, sideways, slow, 3), Harmonics.draw(rng, 0.1 * sideways, tremor, 3))
    orientation = (Harmonics.draw(rng, tilting, (1100.0, 2600.0), 4), Harmonics.draw(rng, 0.1 * tilting, tremor, 3))
    return HandShake(stage, position, orientation)


def rotation_only(stage: Stage, seed: int = 0) -> HandShake:
    """Hand-held motion of a camera whose centre never moves."""
    shaken = hand_shake(stage, seed)
    return HandShake(stage, (), shaken.orientation)


@dataclass(frozen=True)
class Arc:
    """To and fro on a circle around the target, looking at it, with a little shake of the hand."""

    stage: Stage
    swing_rad: float
    period: float
    """Frames from one end to the other and back."""
    shake: HandShake

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        times = np.atleast_1d(np.asarray(frames, np.float64))
        angle = self.swing_rad * np.sin(2 * np.pi * times / self.period)
        up = self.stage.up / np.linalg.norm(self.stage.up)
        centres = self.stage.target + (self.stage.centre - self.stage.target) @ exp_so3(angle[:, None] * up).swapaxes(
            -1, -2
        )
        return _shaken(look_at(centres, self.stage.target, up), centres, self.shake, times)


@dataclass(frozen=True)
class Forward:
    """Towards the target and back along the line of sight, with a little shake of the hand."""

    stage: Stage
    reach: float
    """Length of the way; the start lies a seventh of it from the rear end, so that the camera moves at once."""
    period: float
    shake: HandShake

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        times = np.atleast_1d(np.asarray(frames, np.float64))
        angle = 2 * np.pi * times / self.period
        way = 0.5 * self.reach * (np.sin(angle - np.pi / 4) + np.sqrt(0.5))
        centres = self.stage.centre + way[:, None] * self.stage.rotation[:, 2]
        return _shaken(np.broadcast_to(self.stage.rotation, (len(times), 3, 3)), centres, self.shake, times)


def _shaken(rotations: Array, centres: Array, shake: HandShake, times: Array) -> tuple[Array, Array]:
    """Adds the shake's departure from its own start."""
    start = shake.stage
    turned, moved = shake.poses(times)
    return rotations @ start.rotation.T @ turned, centres + (moved - start.centre)


def _gentle(stage: Stage, seed: int) -> HandShake:
    third = Stage(stage.centre, stage.target, stage.up, stage.focal_px, stage.flow_px / 3, stage.parallax / 3)
    return hand_shake(third, seed)


def arc(stage: Stage, seed: int = 0) -> Arc:
    """An arc whose speed at the start covers `parallax` of the depth in 1,280 frames; turns back after 25 degrees."""
    swing = np.radians(25.0)
    period = max(2 * np.pi * swing * 1280 / max(stage.parallax, 1e-9), 1.0)
    return Arc(stage, float(swing), float(period), _gentle(stage, seed))


def forward(stage: Stage, seed: int = 0) -> Forward:
    """Forward motion that covers `parallax` of the depth in 1,280 frames at its fastest, over 40 % of the depth."""
    reach = 0.4 * stage.depth
    period = np.pi * reach * 1280 / max(stage.parallax * stage.depth, 1e-9)
    return Forward(stage, reach, float(period), _gentle(stage, seed))


@dataclass(frozen=True)
class Kinked:
    """Another path known only every `every` frames and straight in between, like interpolated video."""

    base: Motion
    every: int = 8

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        times = np.atleast_1d(np.asarray(frames, np.float64)) / self.every
        before = np.floor(times)
        share = (times - before)[:, None]
        r0, c0 = self.base.poses(before * self.every)
        r1, c1 = self.base.poses((before + 1) * self.every)
        return r0 @ exp_so3(share * log_so3(r0.swapaxes(-1, -2) @ r1)), c0 + share * (c1 - c0)


def kinked(stage: Stage, seed: int = 0, every: int = 8) -> Kinked:
    """Regime A: straight pieces of `every` frames, with a sway of a few pieces' period so that each kink is real."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0xA]))
    base = hand_shake(stage, seed)
    step = 0.5 * stage.parallax * stage.depth / 1280
    swing = 0.5 * stage.flow_px / stage.focal_px
    sway = (6.0 * every, 16.0 * every)
    position = (*base.position, Harmonics.draw(rng, [step, step, 0.5 * step], sway, 3))
    orientation = (*base.orientation, Harmonics.draw(rng, [swing, swing, 0.5 * swing], sway, 3))
    return Kinked(HandShake(stage, position, orientation), every)


@dataclass(frozen=True)
class StandThenMove:
    """Stands still for `still` frames, then takes up another path within `ease` frames."""

    base: Motion
    still: float = 320.0
    ease: float = 64.0

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        times = np.maximum(np.atleast_1d(np.asarray(frames, np.float64)) - self.still, 0)
        eased = np.where(times < self.ease, times**2 / (2 * self.ease), times - self.ease / 2)
        return self.base.poses(eased)


@dataclass(frozen=True)
class Recorded:
    """A path given as poses, e.g. of a TUM file: even turn and way between two of them, at rest beyond the ends."""

    frames: Array  # [n] increasing times in frames
    rotations: Array  # [n, 3, 3]
    centres: Array  # [n, 3]
    _turns: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.frames) < 2 or np.any(np.diff(self.frames) <= 0):
            raise ConfigurationError("a recorded path needs at least two poses at increasing times")
        object.__setattr__(self, "_turns", log_so3(self.rotations[:-1].swapaxes(-1, -2) @ self.rotations[1:]))

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        times = np.clip(np.atleast_1d(np.asarray(frames, np.float64)), self.frames[0], self.frames[-1])
        i = np.clip(np.searchsorted(self.frames, times, "right") - 1, 0, len(self.frames) - 2)
        share = ((times - self.frames[i]) / (self.frames[i + 1] - self.frames[i]))[:, None]
        rotations = self.rotations[i] @ exp_so3(share * self._turns[i])
        return rotations, self.centres[i] + share * (self.centres[i + 1] - self.centres[i])


def make_motion(kind: MotionKind, stage: Stage, seed: int = 0) -> Motion:
    """The path of a kind, drawn by `seed`."""
    match kind:
        case MotionKind.HAND_SHAKE:
            return hand_shake(stage, seed)
        case MotionKind.ARC:
            return arc(stage, seed)
        case MotionKind.FORWARD:
            return forward(stage, seed)
        case MotionKind.KINKED:
            return kinked(stage, seed)
        case MotionKind.STAND_THEN_MOVE:
            return StandThenMove(hand_shake(stage, seed))
        case MotionKind.ROTATION:
            return rotation_only(stage, seed)
