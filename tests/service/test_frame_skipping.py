"""Skipping frames of a camera that is faster than the tracker, and the reconstruction from its recording."""

from pathlib import Path

import numpy as np
import pytest
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import CaptureState, Grade, JobState, Plan
from spiked_service.workers.frame_skipping import LatestFrames, WindowChooser, may_map, may_sweep
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


BACKLOG_S = 1.5
"""How late a reader of a ring of 1.7 s may be."""


def test_the_newest_frames_are_next_unless_tracks_would_break_on_the_way() -> None:
    windows = WindowChooser(RATE_HZ, BACKLOG_S)
    assert windows.next(at=1000, newest=1500, count=64, speed_px=None) == 1436
    assert windows.next(at=1000, newest=1500, count=64, speed_px=0.01) == 1436
    assert 1000 < windows.next(at=1000, newest=1500, count=64, speed_px=0.2) < 1200
    assert windows.next(at=1000, newest=1030, count=64, speed_px=0.2) == 1000  # they are to come


def followed(window_s: float, speed_px: float, away_s: float, backlog_s: float = BACKLOG_S) -> list[tuple[int, int]]:
    """Frames skipped before each window, and how late the tracker is after it; it was away before the first."""
    windows = WindowChooser(RATE_HZ, backlog_s)
    at, now, out = 0, int(away_s * RATE_HZ), []
    for _ in range(300):
        windows.took(window_s)
        first = windows.next(at, now, 64, speed_px)
        skipped, at = first - at, first + 64
        now = max(now + int(window_s * RATE_HZ), at)
        out.append((skipped, now - at))
    return out


def test_a_pause_is_caught_up_with_in_bounded_steps() -> None:
    """A window takes 40 ms, the camera moves by 0.02 px a frame, and the tracker was away for a second."""
    steps = followed(0.04, 0.02, 1.0)
    assert max(skipped for skipped, _ in steps) * 0.02 <= 61
    assert steps[-1][1] < 1000
    assert next(n for n, (_, late) in enumerate(steps) if late < 1000) < 30


@pytest.mark.parametrize(("window_s", "speed_px"), [(0.04, 0.06), (0.06, 0.04), (0.1, 0.025), (0.15, 0.015)])
def test_no_tracker_is_later_than_the_ring_that_could_keep_up(window_s: float, speed_px: float) -> None:
    """By up to 48 px a window: more than the tracks of a punctual one are asked to survive."""
    assert max(late for _, late in followed(window_s, speed_px, 0.3)) < BACKLOG_S * RATE_HZ


@pytest.mark.parametrize("rate_hz", [1000.0, 2000.0, RATE_HZ])
@pytest.mark.parametrize("count", [20, 32, 64])
def test_the_path_is_bridged_over_what_a_late_tracker_skips(rate_hz: float, count: int) -> None:
    """A slow camera: only the time between the views counts."""
    windows = WindowChooser(rate_hz, BACKLOG_S)
    for late_s in (0.01, 0.1, 0.4, 0.8):
        first = windows.next(at=1000, newest=1000 + int(late_s * rate_hz) + count, count=count, speed_px=0.001)
        assert (first - 1000 + count) / rate_hz < BRIDGED_S  # from the middle of one window to that of the next
    newest = 1000 + int(1.2 * rate_hz)
    assert (windows.next(1000, newest, count, 0.001) - 1000) / rate_hz > BRIDGED_S  # before the ring drops frames


def test_a_tracker_that_cannot_keep_up_without_gaps_does_not_try_to() -> None:
    assert max(skipped for skipped, _ in followed(0.09, 0.001, 0.8)) / RATE_HZ < BRIDGED_S
    steps = followed(0.2, 0.001, 0.8)
    assert steps[-1][1] < 0.5 * RATE_HZ and steps[-1][0] / RATE_HZ > BRIDGED_S


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
