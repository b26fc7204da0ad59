"""Skipping frames of a camera that is faster than the tracker, and the reconstruction from its recording."""

from pathlib import Path

import numpy as np
import pytest
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import CaptureState, Grade, JobState, Plan
from spiked_service.workers.frame_skipping import LatestFrames, may_map, may_sweep, next_window
from waiting import until

from spiked.recon.view_tracking import BRIDGED_S
from spiked.recording import RecordingWriter
from spiked.ring import End, EndReason, Gap, LossCause, Policy, RingReader, RingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

from .survival import jobs_of, kept, over

RATE_HZ = 20_000.0
PACE = 4
"""80 kHz: faster than any machine tracks frames of this size, bootstrap included."""
SENSOR = Sensor(96, 64, RATE_HZ, intrinsics=Intrinsics.from_fov(96, 64, 60))


def test_the_newest_frames_are_next_unless_tracks_would_break_on_the_way() -> None:
    assert next_window(at=1000, newest=1500, count=64, speed_px=None, rate_hz=RATE_HZ) == 1436
    assert next_window(at=1000, newest=1500, count=64, speed_px=0.01, rate_hz=RATE_HZ) == 1436
    assert 1000 < next_window(at=1000, newest=1500, count=64, speed_px=0.2, rate_hz=RATE_HZ) < 1200
    assert next_window(at=1000, newest=1030, count=64, speed_px=0.2, rate_hz=RATE_HZ) == 1000  # they are to come


def test_a_pause_is_caught_up_with_in_bounded_steps() -> None:
    """A window takes 40 ms, the camera moves by 0.02 px a frame, and the tracker was away for a second."""
    at, now = 0, 20_000
    lags = []
    for _ in range(100):
        first = next_window(at, now, 64, 0.02, RATE_HZ)
        assert (first - at) * 0.02 <= 41
        at, now = first + 64, now + 800
        lags.append(now - at)
    assert lags[-1] < 1000
    assert next(n for n, lag in enumerate(lags) if lag < 1000) < 30


@pytest.mark.parametrize("count", [32, 64, 400])
def test_the_path_is_bridged_over_what_a_late_tracker_skips(count: int) -> None:
    """A slow camera: only the time between the views counts."""
    for late in (100, 2000, 8000, 19_000):
        first = next_window(at=1000, newest=1000 + late + count, count=count, speed_px=0.001, rate_hz=RATE_HZ)
        assert (first - 1000 + count) / RATE_HZ < BRIDGED_S  # from the middle of one window to that of the next
    far = next_window(at=1000, newest=26_000, count=count, speed_px=0.001, rate_hz=RATE_HZ)
    assert (far - 1000) / RATE_HZ > BRIDGED_S  # before the ring drops frames
    slow = next_window(at=1000, newest=11_000, count=count, speed_px=0.001, rate_hz=RATE_HZ, window_s=0.1)
    assert (slow - 1000) / RATE_HZ > BRIDGED_S  # it would only come later and later


def test_the_map_gets_a_step_only_if_the_tracks_outlast_it() -> None:
    assert may_map(0, None, RATE_HZ) and may_map(0, 0.009, RATE_HZ) and may_map(600, 0.003, RATE_HZ)
    assert not may_map(0, 0.02, RATE_HZ)  # 8 px in the time of a step
    assert not may_map(600, 0.009, RATE_HZ) and not may_map(900, 0.0, RATE_HZ)


def test_a_sweep_begins_unless_the_tracker_is_far_behind() -> None:
    assert may_sweep(0, 0.05) and may_sweep(700, 0.02)
    assert not may_sweep(800, 0.02) and not may_sweep(1000, None)


def blocks(writer: RingWriter, first: int, count: int) -> None:
    for index in range(first, first + count):
        writer.acquire()[:] = index % 251
        writer.commit(8)


def test_frames_outside_the_windows_are_skipped_and_counted() -> None:
    with RingWriter.create(SENSOR, slots=64) as writer, RingReader.attach(writer.name, Policy.PRIORITY, "it", 0) as it:
        blocks(writer, 0, 20)
        latest = LatestFrames(it, 0)
        latest.track_latest(83, 32)
        taken = latest.take(1.0)
        assert isinstance(taken, tuple)
        first, frames = taken
        assert first == 80 and len(frames) == 32
        assert [int(frame[0]) for frame in frames[::8]] == [10, 11, 12, 13]
        assert (latest.at, latest.skipped) == (112, 80)
        latest.track_latest(150, 32)
        assert latest.take(0.0) is None  # the camera is not that far
        writer.gap(40, LossCause.USB)
        assert latest.take(1.0) == Gap(160, 40, LossCause.USB)
        assert latest.at == 200
        blocks(writer, 25, 4)
        taken = latest.take(1.0)
        assert isinstance(taken, tuple) and taken[0] == 200 and len(taken[1]) == 32
        writer.end(EndReason.FINISHED)
        assert isinstance(latest.take(1.0), End)
        counters = it.status().readers[0]
        assert (counters.frames_read, counters.lost) == (192, 40)
        assert latest.skipped == 192 - 64


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """0.5 s of 20 kHz, with a path that is found."""
    camera = SimulatedCamera(SENSOR, seed=2, motion=MotionKind.ARC, flow_px=0.02, parallax=0.5)
    path = tmp_path_factory.mktemp("fast") / "fast.dat"
    with RecordingWriter(path, SENSOR) as writer:
        for _ in range(100):
            writer.append(np.asarray(camera.next_frames(100)))
    return path


def test_a_fast_camera_is_followed_live_and_then_reconstructed_with_every_frame(
    recording: Path, tmp_path: Path
) -> None:
    with kept(tmp_path / "data") as data_store:
        plan = Plan(f"replay:{recording}?pace={PACE}", options=ReconstructionOptions(steps=5))
        capture = over(data_store, data_store.captures.start(plan).id)
        assert capture.row.state is CaptureState.COMPLETE
        assert capture.row.recording is not None and capture.row.recording.frames == 10_000
        assert capture.row.verdict is not None and capture.row.verdict.grade is Grade.GOOD
        job = jobs_of(data_store, capture.id)[0]
        assert any("were skipped live" in warning for warning in capture.row.warnings), capture.row
        until(lambda: data_store.reconstructions.rows.get(job.id).state.over, "it is gone through once more")
        done = data_store.reconstructions.rows.get(job.id)
        assert (done.state, done.live, done.attempts, done.frames) == (JobState.COMPLETE, False, 2, 10_000)


def test_what_nobody_records_is_refined_as_it_was_seen(recording: Path, tmp_path: Path) -> None:
    with kept(tmp_path / "data") as data_store:
        plan = Plan(f"replay:{recording}?pace={PACE}", record=False, options=ReconstructionOptions(steps=5))
        capture = over(data_store, data_store.captures.start(plan).id)
        assert capture.row.state is CaptureState.COMPLETE
        job = jobs_of(data_store, capture.id)[0]
        assert (job.state, job.live, job.attempts) == (JobState.COMPLETE, True, 1)
