"""`Status.left_s`, and what it is computed from."""

import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from spiked_service.results.recording_feed import reconstruct_recording

from spiked.recon import MapOptions, Options, Reconstructor, Status
from spiked.recon.mapping.schedule import Schedule
from spiked.recon.time_left import LONG_END, Pace, Part, RefinementPlan, TimeLeft, typical_work_s
from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

SENSOR = Sensor(160, 104, 20_000.0, intrinsics=Intrinsics.from_fov(160, 104, 60))
PLAN = RefinementPlan(
    1000, 11, Schedule.align_at, 80, 0, 100_000, 80_000, coloured=False, fast=False, options=MapOptions(), threads=2
)


def test_a_pace_follows_other_programs_that_come() -> None:
    pace = Pace()
    assert pace.value(1.3) == pytest.approx(1.3), "nothing is known: that of the other parts"
    for _ in range(100):
        pace.add(1.0, 1.0)
    assert pace.value(1.3) == pytest.approx(1.0, abs=0.02)
    for _ in range(30):
        pace.add(1.0, 2.0)
    assert pace.value(1.3) == pytest.approx(2.0, abs=0.1)


def test_steps_cost_more_once_the_map_has_grown_and_large_images_are_whole() -> None:
    first, last = PLAN.step_s(0, 28_000), PLAN.step_s(999, 80_000)
    assert 1.4 < last / first < 1.8, "living: 26 and 40 ms"
    assert PLAN.steps_s(0, 28_000) > 1000 * first
    large = replace(PLAN, pixels=1_000_000)
    assert 2.0 < large.step_s(999, 80_000) / large.step_s(0, 80_000) < 2.5, "camp_color: 4 x 4 pixels are one at first"
    pruned = replace(PLAN, pruned_views=160)
    assert pruned.steps_s(0, 28_000) < PLAN.steps_s(0, 28_000)
    assert PLAN.steps_s(1000, 80_000) == 0


def test_what_is_done_is_not_left() -> None:
    before, begun, ended = PLAN.work(None, 0), PLAN.work(0, 28_000), PLAN.work(1000, 80_000)
    assert before[Part.SEEDING] > 0 == begun[Part.SEEDING]
    assert begun[Part.ALIGNING] == pytest.approx(5 * PLAN.aligning_s(54_000))
    assert set(ended.values()) == {0.0}
    due = [PLAN.alignments_due(share) for share in (0.0, 0.13, 0.3, 0.69, 0.7, 1.0)]
    assert due == [0, 0, 2, 4, 5, 5]
    assert all(part[Part.PRUNING] == 0 for part in (before, begun, ended)), "short paths are not pruned"


def test_seconds_follow_the_paces_of_the_parts_and_end_with_the_budget() -> None:
    clock = TimeLeft(frames=20_000)
    clock.start()
    time.sleep(0.02)
    clock.tracked(10_000, 500, 500, SENSOR)
    tracking = clock.tracking(long=False, speed_px=0.1, sensor=SENSOR)
    done, pace = clock._paces[Part.TRACKING].work_s, clock._paces[Part.TRACKING].seconds
    assert tracking[Part.TRACKING] <= done, "a long path has no more views than before"
    assert tracking[Part.ENDING] == pytest.approx(LONG_END * (done + tracking[Part.TRACKING]))
    assert clock.seconds({Part.TRACKING: done}) < 1.1 * (pace + done)
    clock.start(deadline=time.perf_counter() + 1.0)
    assert clock.seconds({Part.STEPS: 1000.0}) <= 1.0


def test_longer_recordings_take_longer_but_not_in_proportion() -> None:
    work = [typical_work_s(400, 250, frames, 2000) for frames in (1_280, 12_000, 200_000, 1_200_000)]
    assert all(one < other for one, other in pairwise(work))
    assert 60 < work[0] < 110, "living takes 86 s of CPU"
    assert work[2] < 10 * work[0], "156 times the frames"


def test_a_reconstruction_says_when_it_will_end(tmp_path: Path) -> None:
    camera = SimulatedCamera(SENSOR, seed=3, motion=MotionKind.ARC, flow_px=0.25, parallax=0.5)
    with RecordingWriter(tmp_path / "room.dat", SENSOR) as writer:
        writer.append(camera.next_frames(640))
    recording = open_recording(tmp_path / "room.dat")
    reconstructor = Reconstructor(recording.sensor, Options(steps=300), recording=recording)
    assert reconstructor.status().left_s is None, "nobody knows how many frames will come"
    told: list[Status] = []
    reconstruct_recording(recording, reconstructor, progress=told.append, cancelled=lambda: False)
    left = [status.left_s for status in told if status.left_s is not None]
    assert len(left) == len(told) and left[-1] == 0 and min(left) == 0
    refining = [status.left_s for status in told if status.stage == "refining"]
    assert len(refining) == 6 and refining[-1] is not None and refining[-1] < 0.5 * left[0]
