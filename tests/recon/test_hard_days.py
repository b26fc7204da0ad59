"""Days on which the camera or the scene does not behave: each ends in a state and a reason, never in a wrong map."""

import numpy as np

from spiked.recon import Options, Reconstructor, State
from spiked.recon.odometry.pnp import WORST_SIGMA_PX
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.motion import Motion

SENSOR = Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 60))


def camera(motion: Motion | MotionKind = MotionKind.ARC, sensor: Sensor = SENSOR) -> SimulatedCamera:
    return SimulatedCamera(sensor, seed=2, motion=motion, flow_px=0.3, parallax=0.5)


def run(frames: np.ndarray, sensor: Sensor = SENSOR, first: int = 0) -> Reconstructor:
    reconstructor = Reconstructor(sensor, Options(steps=0))
    for i in range(0, len(frames), 64):
        reconstructor.feed(first + i, frames[i : i + 64])
    return reconstructor


def finite(reconstructor: Reconstructor) -> bool:
    path = reconstructor.trajectory()
    return bool(np.isfinite(path.rotations).all() and np.isfinite(path.centres).all())


def test_a_flipped_recording_is_a_mirrored_world_that_is_reconstructed_all_the_same() -> None:
    frames = camera().next_frames(400)
    bits = np.unpackbits(frames.reshape(400, 160, 30), axis=2, bitorder="little")[:, :, ::-1]
    mirrored = np.packbits(bits, axis=2, bitorder="little").reshape(400, -1)
    plain, flipped = run(frames), run(mirrored)
    for one in (plain, flipped):
        one.finish()
        assert one.status().state is State.TRACK, one.status().reason
    a, b = plain.trajectory().centres, flipped.trajectory().centres
    way_a, way_b = (np.ptp(c, axis=0) for c in (a, b))
    np.testing.assert_allclose(way_b / np.linalg.norm(way_b), way_a / np.linalg.norm(way_a), atol=0.2)


def test_a_gap_of_a_thousand_frames_is_told_and_nothing_becomes_nan() -> None:
    source = camera()
    before = source.next_frames(320)
    source.next_frames(1000)
    after = source.next_frames(256)
    reconstructor = run(before)
    reconstructor.gap(320, 1000)
    for i in range(0, len(after), 64):
        reconstructor.feed(1320 + i, after[i : i + 64])
    reconstructor.finish()
    status = reconstructor.status()
    assert finite(reconstructor) and status.reason
    assert status.state in {State.TRACK, State.DEGRADED, State.LOST, State.RELOC}
    times = reconstructor.trajectory().times_s * 20000
    assert not ((times > 360) & (times < 1280)).any(), "no poses are invented inside the gap"


def test_the_newest_pose_comes_with_its_predicted_error_and_fit() -> None:
    reconstructor = run(camera().next_frames(400))
    status = reconstructor.status()
    assert status.state is State.TRACK, status.reason
    assert status.sigma_px is not None and 0 < status.sigma_px < WORST_SIGMA_PX
    assert status.chi2 is not None and status.chi2 < 2.5
    assert status.inliers is not None and status.inliers > 0.5
