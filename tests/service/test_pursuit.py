"""A camera that is faster than the tracker is followed at a glance, and then from its recording."""

from pathlib import Path

import numpy as np
import pytest
from spiked_service.pursuit import Glances, next_glance
from spiked_service.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import CaptureState, Grade, JobState, Plan

from spiked.recording import RecordingWriter
from spiked.ring import Cause, End, EndReason, Gap, Policy, RingReader, RingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

from .survival import kept, over, wait_for

RATE_HZ = 20_000.0
PACE = 4
"""80 kHz: faster than any machine tracks frames of this size, bootstrap included."""
SENSOR = Sensor(96, 64, RATE_HZ, intrinsics=Intrinsics.from_fov(96, 64, 60))


def test_the_newest_frames_are_next_unless_tracks_would_break_on_the_way() -> None:
    assert next_glance(at=1000, newest=1500, count=64, speed_px=None, rate_hz=RATE_HZ) == 1436
    assert next_glance(at=1000, newest=1500, count=64, speed_px=0.01, rate_hz=RATE_HZ) == 1436
    assert 1000 < next_glance(at=1000, newest=1500, count=64, speed_px=0.2, rate_hz=RATE_HZ) < 1200
    assert next_glance(at=1000, newest=1030, count=64, speed_px=0.2, rate_hz=RATE_HZ) == 1000  # they are to come


def test_a_pause_is_caught_up_with_in_bounded_steps() -> None:
    """A glance takes 40 ms, the camera moves by 0.02 px a frame, and the tracker was away for a second."""
    at, now = 0, 20_000
    lags = []
    for _ in range(100):
        first = next_glance(at, now, 64, 0.02, RATE_HZ)
        assert (first - at) * 0.02 <= 61
        at, now = first + 64, now + 800
        lags.append(now - at)
    assert lags[-1] < 1000
    assert next(n for n, lag in enumerate(lags) if lag < 1000) < 30


def blocks(writer: RingWriter, first: int, count: int) -> None:
    for index in range(first, first + count):
        writer.acquire()[:] = index % 251
        writer.commit(8)


def test_what_is_not_looked_at_is_passed_over_and_every_frame_is_accounted_for() -> None:
    with RingWriter.create(SENSOR, slots=64) as writer, RingReader.attach(writer.name, Policy.PRIORITY, "it", 0) as it:
        blocks(writer, 0, 20)
        glances = Glances(it, 0)
        glances.look_at(83, 32)
        taken = glances.take(1.0)
        assert isinstance(taken, tuple)
        first, frames = taken
        assert first == 80 and len(frames) == 32
        assert [int(frame[0]) for frame in frames[::8]] == [10, 11, 12, 13]
        assert (glances.at, glances.passed) == (112, 80)
        glances.look_at(150, 32)
        assert glances.take(0.0) is None  # the camera is not that far
        writer.gap(40, Cause.USB)
        assert glances.take(1.0) == Gap(160, 40, Cause.USB)
        assert glances.at == 200
        blocks(writer, 25, 4)
        taken = glances.take(1.0)
        assert isinstance(taken, tuple) and taken[0] == 200 and len(taken[1]) == 32
        writer.end(EndReason.FINISHED)
        assert isinstance(glances.take(1.0), End)
        counters = it.status().readers[0]
        assert (counters.received, counters.lost) == (192, 40)
        assert glances.passed == 192 - 64


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """0.5 s of 20 kHz."""
    camera = SimulatedCamera(SENSOR, seed=2, motion=MotionKind.ARC, flow_px=0.02, parallax=0.1)
    path = tmp_path_factory.mktemp("fast") / "fast.dat"
    with RecordingWriter(path, SENSOR) as writer:
        for _ in range(100):
            writer.append(np.asarray(camera.next_frames(100)))
    return path


def test_a_fast_camera_is_followed_live_and_then_reconstructed_with_every_frame(
    recording: Path, tmp_path: Path
) -> None:
    with kept(tmp_path / "data") as keeping:
        plan = Plan(f"replay:{recording}?pace={PACE}", options=ReconstructionOptions(steps=5))
        capture = over(keeping, keeping.captures.start(plan).id)
        assert capture.row.state is CaptureState.COMPLETE
        assert capture.row.recording is not None and capture.row.recording.frames == 10_000
        assert capture.row.verdict is not None and capture.row.verdict.grade is Grade.GOOD
        job = capture.reconstructions[0]
        assert any("passed over" in warning for warning in capture.row.warnings), capture.row
        wait_for(lambda: keeping.reconstructions.get(job.id).state.over, "it is gone through once more")
        done = keeping.reconstructions.get(job.id)
        assert (done.state, done.live, done.attempts, done.frames) == (JobState.COMPLETE, False, 2, 10_000)


def test_what_nobody_records_is_refined_as_it_was_seen(recording: Path, tmp_path: Path) -> None:
    with kept(tmp_path / "data") as keeping:
        plan = Plan(f"replay:{recording}?pace={PACE}", record=False, options=ReconstructionOptions(steps=5))
        capture = over(keeping, keeping.captures.start(plan).id)
        assert capture.row.state is CaptureState.COMPLETE
        job = capture.reconstructions[0]
        assert (job.state, job.live, job.attempts) == (JobState.COMPLETE, True, 1)
