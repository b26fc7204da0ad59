"""Where no view says where the camera was, it went on evenly; and each track belongs to its own moment."""

import numpy as np

from spiked.pose import exp_so3
from spiked.recon.frontend.track_timestamps import TrackTimestamps
from spiked.recon.odometry.smoothness_prior import SmoothnessPrior
from spiked.recon.odometry.spline_fitting import knot_time_warp
from spiked.spline import KnotTimeWarp, Spline


def test_the_energy_has_the_gradient_that_it_says() -> None:
    rng = np.random.default_rng(0)
    spline = Spline(0.0, 8.0, exp_so3(0.02 * rng.normal(size=(12, 3))), 0.1 * rng.normal(size=(12, 3)))
    inertia = SmoothnessPrior.of(spline, spline.basis_matrix(np.arange(0, 70, 2.0)), 0.1)
    gradient, step = inertia.gradient(spline), 1e-6
    for knot, axis in ((0, 4), (5, 1), (11, 3)):
        push = np.zeros((12, 6))
        push[knot, axis] = step
        ends = [inertia.energy(spline.move(s * push[:, :3], s * push[:, 3:])) for s in (1, -1)]
        measured = (ends[0] - ends[1]) / (2 * step)
        assert abs(measured - gradient[knot, axis]) < 0.05 * np.abs(gradient).max()


def test_an_even_path_has_no_energy() -> None:
    knots = np.arange(10.0)[:, None]
    spline = Spline(0.0, 8.0, exp_so3(knots * [0.0, 0.01, 0.0]), knots * [0.1, 0.2, 0.0])
    assert SmoothnessPrior.of(spline, spline.basis_matrix(np.arange(0, 50, 4.0)), 0.1).energy(spline) < 1e-6


def test_tracks_are_brought_to_the_time_of_their_view() -> None:
    """The last view of a recording knows only what happened before its end: it once lagged behind by half a window."""
    rng = np.random.default_rng(1)
    start = rng.uniform(20, 200, (40, 2))
    ids, speed = np.arange(40), np.array([0.2, -0.1])
    stamps = TrackTimestamps()
    for time, late in ((8.0, 0.0), (16.0, 0.3), (24.0, -3.0)):
        seen = start + speed * (time + late)
        at, unsure = stamps.align(time, ids, seen, np.full(40, late))
    np.testing.assert_allclose(at, start + speed * 24.0, atol=1e-9)
    assert 0 < unsure < np.linalg.norm(3 * speed)


def test_knots_are_not_spent_on_a_camera_that_stands_still() -> None:
    times = np.concatenate([np.arange(32, 9600, 64.0), np.arange(9604, 10200, 8.0)])
    time_warp = knot_time_warp(times, times < 9600)
    assert time_warp is not None
    spline = Spline.fit(
        times, np.tile(np.eye(3), (len(times), 1, 1)), np.zeros((len(times), 3)), 16, time_warp=time_warp
    )
    knots = time_warp.to_frame(spline.first + spline.spacing * np.arange(len(spline.centres)))
    assert (knots > 9600).sum() > 30 and len(knots) < 130
    assert spline.begin <= times[0] + 1e-3 and spline.end >= times[-1] - 1e-3
    assert knot_time_warp(times[times > 9600], np.zeros(75, bool)) is None


def test_a_clock_can_be_read_both_ways() -> None:
    time_warp = KnotTimeWarp(np.array([0.0, 100.0, 164.0]), np.array([0.0, 100.0, 108.0]))
    times = np.array([-5.0, 30.0, 120.0, 170.0])
    np.testing.assert_allclose(time_warp.to_frame(time_warp.to_knot(times)), times)
