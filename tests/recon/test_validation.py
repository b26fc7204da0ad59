"""The method's own list of figures to hold; docs/validation.md says which other tests belong to it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import staging
from staging import SENSOR

from spiked.evaluate import psnr, similarity_of_trajectories
from spiked.noise import measure_noise
from spiked.pose import Array
from spiked.recon import Options, Reconstructor, State
from spiked.recording import open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import Lighting, MotionKind, PixelMaps, SimulatedCamera
from spiked.simulate.motion import Motion, Recorded, make_motion
from spiked.simulate.room import Room
from spiked.trajectory import Trajectory

pytestmark = pytest.mark.validation
Figure = Callable[[str, object, str], None]


def test_counts_of_a_real_camera_vary_less_than_any_binomial(shared: Path, figure: Figure) -> None:
    recording = open_recording(shared / "real" / "static_fence.dat", width=400, height=250, frame_rate_hz=20000.0)
    (row,) = (row for row in measure_noise(recording).windows if row.frames == 32)
    variance = row.variance
    figure("noise on static_fence: var(count, n = 32)", f"{variance:.3f}", "0.15 to 0.25")
    assert 0.15 < variance < 0.25
    assert row.charge < row.counted / 2


def test_tracks_have_no_bias(figure: Figure) -> None:
    """Where the scene's points really are, from its exact depth; things at edges of depth belong to neither side."""
    sensor = Sensor(400, 250, 20000.0, intrinsics=Intrinsics.from_fov(400, 250, 60))
    camera = SimulatedCamera(sensor, 1, MotionKind.HAND_SHAKE, flow_px=0.3, parallax=0.5)
    frames = camera.next_frames(240)
    reconstructor = Reconstructor(sensor, Options(steps=0))
    for first in range(0, len(frames), 40):
        reconstructor.feed(first, frames[first : first + 40])
    assert sensor.intrinsics is not None
    k, places = sensor.intrinsics, np.full((len(reconstructor.odometry.points), 3), np.nan)
    known, errors = np.zeros(len(places), bool), []
    for view in reconstructor.odometry.views[2:]:  # in the first two, the speed of the tracks is not known
        (rotation,), (centre,) = camera.motion.poses([view.time])
        local = (places[view.ids] - centre) @ rotation
        errors.append(local[:, :2] / local[:, 2:] * [k.fx, k.fy] + [k.cx, k.cy] - view.pixels)
        depth, new = camera.depth(rotation, centre), ~known[view.ids]
        for i, (x, y) in zip(view.ids[new], view.pixels[new], strict=True):
            around = depth[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2]
            if np.ptp(around) < 0.02 * around.mean():
                places[i] = centre + rotation @ (around[1, 1] * np.array([(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1]))
        known[view.ids] = True
    error = np.concatenate(errors)
    moved = error[np.isfinite(error[:, 0]) & (np.abs(error) > 1e-9).any(1)]
    bias = float(np.abs(np.median(moved, axis=0)).max())
    figure("tracking bias, px (larger of x and y)", f"{bias:.3f}", "< 0.02")
    assert len(moved) > 2000 and bias < 0.02


def arc(away: tuple[float, float] | None = None) -> Motion:
    """A steady path; where it is `away` from a frame to another, it goes on afterwards from where it left."""
    assert SENSOR.intrinsics is not None
    path = make_motion(MotionKind.ARC, Room(False, 2).stage(SENSOR.intrinsics, 0.3, 0.5), 2)
    if away is None:
        return path
    times = np.arange(0.0, away[1] + 400, 4)
    return Recorded(times, *path.poses(np.minimum(times, away[0]) + np.maximum(times - away[1], 0)))


@pytest.mark.parametrize("lost", [1, 10, 100, 1000])
def test_a_gap_is_left_behind_in_four_blocks(lost: int, figure: Figure) -> None:
    """In a thousand frames the whole view would have changed: there the camera comes back."""
    begin = 320
    camera = SimulatedCamera(SENSOR, 2, arc((begin, begin + lost) if lost == 1000 else None))
    reconstructor, error, _ = staging.followed(camera, begin + lost + 160, (begin, begin + lost))
    views = [v for v in reconstructor.odometry.views if v.time > begin + lost]
    found = next(n for n, view in enumerate(views) if view.rotation is not None and view.state is not State.LOST)
    blocks = (views[found].time - begin - lost) / 8
    figure(f"gap of {lost} frames: blocks until found; ATE", f"{blocks:.1f}; {error:.2f} %", "< 4; no NaN")
    assert blocks < 4 and error < 3
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason


@pytest.mark.slow
def test_gains_and_flicker_cost_less_than_half_a_decibel(figure: Figure) -> None:
    gain = np.exp(0.03 * np.random.default_rng(5).standard_normal((160, 240))).astype(np.float32)
    dark = np.full((160, 240), 0.002, np.float32)
    plain = _quality(PixelMaps(np.ones_like(gain), dark), Lighting())
    injected = _quality(PixelMaps(gain, dark), Lighting(flicker=0.10, flicker_hz=100))
    figure("3 % gain and 10 % flicker: PSNR lost, dB", f"{plain - injected:.2f} of {plain:.1f}", "< 0.5")
    assert plain - injected < 0.5


def _quality(maps: PixelMaps, lighting: Lighting, frames: int = 480) -> float:
    """Mean PSNR of the map against noise-free pictures along the path, brightness left to a common factor."""
    camera = SimulatedCamera(SENSOR, 2, MotionKind.ARC, flow_px=0.3, parallax=0.5, maps=maps, lighting=lighting)
    reconstructor = Reconstructor(SENSOR, Options(steps=1200))
    taken = camera.next_frames(frames)
    for first in range(0, frames, 40):
        reconstructor.feed(first, taken[first : first + 40])
    reconstructor.finish()
    k = np.arange(frames)
    truth = Trajectory((k + 0.5) / SENSOR.frame_rate_hz, *camera.truth(k))
    carried = similarity_of_trajectories(
        truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=SENSOR.frame_rate_hz
    )
    figures = []
    for at in (60, 150, 240, 330, 420):
        rotation, centre = carried.poses(truth.rotations[at : at + 1], truth.centres[at : at + 1])
        seen: Array = camera.view(truth.rotations[at], truth.centres[at]).astype(float)
        rendered = reconstructor.view(rotation[0], centre[0])[..., 0].astype(float)
        factor = (rendered * seen).sum() / (rendered**2).sum()
        figures.append(psnr(factor * rendered / camera.gain, seen / camera.gain))
    return float(np.mean(figures))
