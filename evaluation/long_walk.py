"""Make a longer camera path of a short one: round after round through the same places, with another tremor each time.

    .venv/bin/python evaluation/long_walk.py PATH.tum LONG.tum [--seconds 60] [--seed 0]
    .venv/bin/spiked simulate --scene SCENE.ply --poses LONG.tum --fov 60 --frames 1200000 --views 40 -o long

The path must come back near a pose of its first half; from there it goes on as the first time. What is left between
the two poses fades within a second. The hand's tremor (1.5 to 12.5 Hz) is taken off by smoothing and replaced by random
motion with the same spectrum.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.pose import exp_so3, log_so3, quaternion, rotation_of
from spiked.trajectory import Trajectory

Array = NDArray[np.float64]

SMOOTH_S = 0.12
"""Standard deviation of the Gaussian that takes off the tremor."""

TREMOR_HZ = (1.5, 12.5)
"""Frequencies of a hand's tremor."""

FADE_S = 1.0


def smooth(path: Trajectory) -> Trajectory:
    """The path without its tremor. Poses must be evenly spaced."""
    step = np.median(np.diff(path.times_s))
    q = quaternion(path.rotations)
    flips = np.cumprod(np.r_[1, np.where((q[1:] * q[:-1]).sum(1) < 0, -1, 1)])
    both = np.concatenate([path.centres, q * flips[:, None]], 1)
    both = cv2.GaussianBlur(both, (1, 0), sigmaX=1e-3, sigmaY=SMOOTH_S / step, borderType=cv2.BORDER_REPLICATE)
    return Trajectory(path.times_s, rotation_of(both[:, 3:]), both[:, :3])


def return_index(path: Trajectory) -> int:
    """The pose of the first half that is most like the last pose; a metre counts as much as a radian."""
    half = len(path) // 2
    turn = np.linalg.norm(log_so3(path.rotations[:half].swapaxes(1, 2) @ path.rotations[-1]), axis=1)
    return int(np.argmin(turn + np.linalg.norm(path.centres[:half] - path.centres[-1], axis=1)))


def repeat(path: Trajectory, poses: int) -> Trajectory:
    """`poses` poses: the path, and again from where it has come back to."""
    back = return_index(path)
    lap = len(path) - 1 - back
    number = np.arange(poses)
    index = np.where(number < len(path), number, back + (number - back) % lap)
    step = np.median(np.diff(path.times_s))
    since = (number - len(path) + 1) % lap * step
    left = np.where(number < len(path), 0, np.square(np.cos(np.clip(since / FADE_S, 0, 1) * np.pi / 2)))[:, None]
    offset = path.centres[-1] - path.centres[back]
    turn = log_so3(path.rotations[-1] @ path.rotations[back].T)
    rotations = exp_so3(left * turn) @ path.rotations[index]
    return Trajectory(path.times_s[0] + number * step, rotations, path.centres[index] + left * offset)


def tremor_like(tremor: Array, step_s: float, count: int, rng: np.random.Generator) -> Array:
    """Random motion [count, d] with the spectrum of `tremor` [n, d] within `TREMOR_HZ`."""
    spectrum = np.abs(np.fft.rfft(tremor, axis=0))
    old, new = np.fft.rfftfreq(len(tremor), step_s), np.fft.rfftfreq(count, step_s)
    spectrum[(old < TREMOR_HZ[0]) | (old > TREMOR_HZ[1])] = 0
    size = np.stack([np.interp(new, old, column) for column in spectrum.T], 1)
    drawn = np.fft.irfft(size * (rng.standard_normal(size.shape) + 1j * rng.standard_normal(size.shape)), count, axis=0)
    strength = np.sqrt(2 * np.square(spectrum).sum(0)) / len(tremor)
    return np.asarray(drawn * strength / drawn.std(0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    path = Trajectory.read_tum(given.path)
    step = float(np.median(np.diff(path.times_s)))
    calm = smooth(path)
    turns = log_so3(calm.rotations.swapaxes(1, 2) @ path.rotations)
    tremor = np.concatenate([path.centres - calm.centres, turns], 1)
    poses = round(given.seconds / step) + 1
    long = smooth(repeat(calm, poses))
    shake = tremor_like(tremor, step, poses, np.random.default_rng(given.seed))
    Trajectory(long.times_s, long.rotations @ exp_so3(shake[:, 3:]), long.centres + shake[:, :3]).write_tum(given.out)


if __name__ == "__main__":
    main()
