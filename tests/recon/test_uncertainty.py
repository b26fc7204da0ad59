"""The predicted error of a whole path is the one that the noise of the tracks makes."""

import numpy as np

from spiked.evaluate import pose_errors
from spiked.pose import exp_so3
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.uncertainty import path_error
from spiked.sensor import Intrinsics
from spiked.spline import Spline

K = Intrinsics.from_fov(400, 250, 60)


def test_predicted_and_true_errors_agree() -> None:
    times = np.arange(4.0, 164.0, 8.0)
    s = (times / 164)[:, None]
    rotations, centres = exp_so3(s * [0.02, -0.1, 0.01]), s * [0.3, 0.05, 0.02] + 0.02 * np.sin(6 * s) * [0, 1, 0]
    predicted, actual = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points = rng.uniform([-0.5, -0.3, 0.8], [0.6, 0.3, 1.8], (40, 3))
        local = np.einsum("vji,vpj->vpi", rotations, points[None] - centres[:, None])
        pixels = local[..., :2] / local[..., 2:] * K.fx + [K.cx, K.cy] + rng.normal(scale=0.1, size=(20, 40, 2))
        camera, point = np.divmod(np.arange(20 * 40), 40)
        bundle = Bundle(rotations.copy(), centres.copy(), points, camera, point, pixels.reshape(-1, 2), K)
        start = Spline.fit(times, rotations, centres, 40)
        spline, _ = bundle.optimise_spline(start, times, 20, 1.0, tolerance=1e-6)
        predicted.append(100 * path_error(bundle, spline, times, 1.0))
        actual.append(pose_errors(truth=(rotations, centres), estimate=spline.poses(times)).ate_percent)
    assert 0.4 < np.sqrt(np.mean(np.square(actual))) / np.sqrt(np.mean(np.square(predicted))) < 2.5
