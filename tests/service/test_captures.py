"""Captures: recorded as they were, several at once, judged, and closed cleanly whatever their workers and disk do."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from spiked_service.errors import BusyError
from spiked_service.keeping import Keeping
from spiked_service.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import CaptureState, Grade, JobState, Plan

from spiked.errors import ConfigurationError
from spiked.recording import open_recording, verify
from spiked.sensor import Sensor

from .survival import (
    SMALL,
    assert_holds,
    children,
    kept,
    over,
    random_recording,
    received,
    wait_for,
)


@pytest.fixture
def keeping(tmp_path: Path) -> Iterator[Keeping]:
    with kept(tmp_path / "data") as one:
        yield one
    wait_for(lambda: children() == [], "every worker has left")


def recorded_only(source: str, **more: object) -> Plan:
    return Plan(source, reconstruct=False, **more)  # type: ignore[arg-type]


def test_a_recording_holds_what_the_source_gave(keeping: Keeping, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 1000)
    plan = recorded_only(f"replay:{tmp_path / 'noise.dat'}?pace=0.1", name="noise", notes="by hand")
    started = keeping.captures.start(plan)
    done = over(keeping, started.id)
    row = done.row
    assert (row.state, row.reason, row.warnings) == (CaptureState.COMPLETE, "", ())
    assert (row.name, row.notes, row.frames_planned) == ("noise", "by hand", 1000)
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (1000, 0)
    assert row.recording.bytes == frames.nbytes
    assert row.verdict is not None and row.verdict.grade is Grade.GOOD
    assert done.reconstructions == ()
    path = keeping.captures.recording(row.id)
    assert path.read_bytes() == frames.tobytes()
    checked = verify(path)
    assert (checked.verdict, checked.reasons) == ("good", ())
    assert len(checked.recording.clock) >= 1
    assert keeping.folder.thumbnail(row.id).read_bytes().startswith(b"RIFF")
    assert keeping.captures.picture(row.id) is not None


def test_frames_the_source_lost_are_gaps_of_the_recording(keeping: Keeping, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 600)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=0&gap=100:7&gap=300:50:device"
    row = over(keeping, keeping.captures.start(recorded_only(source)).id).row
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (543, 57)
    assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
    assert row.verdict.reasons == ("57 of 600 frames were lost (device 50, usb 7)",)
    assert_holds(keeping.captures.recording(row.id), frames)
    assert [(gap.first, gap.count) for gap in open_recording(keeping.captures.recording(row.id)).gaps] == [
        (100, 7),
        (300, 50),
    ]


def test_a_killed_recorder_is_followed_and_nothing_is_lost(keeping: Keeping, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=1&repeat=1000"
    capture_id = keeping.captures.start(recorded_only(source)).id
    for kills in range(2):
        wait_for(lambda: received(keeping, capture_id) > 20_000 * (kills + 1), "frames come")  # noqa: B023
        pid = keeping.captures.processes()[capture_id]["recorder"]
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: keeping.captures.processes()[capture_id].get("recorder", pid) != pid, "another")  # noqa: B023
    wait_for(lambda: received(keeping, capture_id) > 60_000, "frames come")
    keeping.captures.stop(capture_id)
    row = over(keeping, capture_id).row
    assert row.state is CaptureState.COMPLETE
    assert list(row.warnings) == ["the recorder worker was killed by signal 9; another went on where it stopped"] * 2
    assert row.recording is not None and row.counters is not None
    assert row.recording.frames + row.recording.lost == row.counters.next_frame
    assert_holds(keeping.captures.recording(capture_id), frames)
    assert row.recording.lost == 0, row.verdict


def test_a_source_that_waits_waits_for_the_successor_of_a_killed_recorder(keeping: Keeping, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=0&repeat=300"
    capture_id = keeping.captures.start(recorded_only(source)).id
    wait_for(lambda: received(keeping, capture_id) > 500, "frames come")
    os.kill(keeping.captures.processes()[capture_id]["recorder"], signal.SIGKILL)
    row = over(keeping, capture_id).row
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (997 * 300, 0)
    assert row.verdict is not None and row.verdict.grade is Grade.GOOD
    assert_holds(keeping.captures.recording(capture_id), frames)


def test_a_disk_that_stalls_costs_frames_that_are_told(keeping: Keeping, tmp_path: Path) -> None:
    sensor = Sensor(400, 250, 20_000.0)
    frames = random_recording(tmp_path / "noise.dat", 500, sensor)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=0.5&repeat=1000"
    capture_id = keeping.captures.start(recorded_only(source)).id
    wait_for(lambda: received(keeping, capture_id) > 2_000, "frames come")
    recorder = psutil.Process(keeping.captures.processes()[capture_id]["recorder"])
    recorder.suspend()
    before = received(keeping, capture_id)
    wait_for(lambda: received(keeping, capture_id) > before + 12_000, "more than the ring holds has come")
    recorder.resume()
    keeping.captures.stop(capture_id)
    row = over(keeping, capture_id).row
    assert row.state is CaptureState.COMPLETE
    assert row.recording is not None and row.counters is not None and row.verdict is not None
    assert row.recording.lost > 0
    assert row.recording.frames + row.recording.lost == row.counters.next_frame
    assert row.verdict.grade is Grade.DEGRADED and "(disk " in row.verdict.reasons[0]
    assert_holds(keeping.captures.recording(capture_id), frames)


def test_a_killed_acquisition_leaves_a_recording(keeping: Keeping, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 500)
    source = f"replay:{tmp_path / 'noise.dat'}?repeat=1000"
    capture_id = keeping.captures.start(recorded_only(source)).id
    wait_for(lambda: received(keeping, capture_id) > 1000, "frames come")
    os.kill(keeping.captures.processes()[capture_id]["acquisition"], signal.SIGKILL)
    row = over(keeping, capture_id).row
    assert (row.state, row.reason) == (CaptureState.FAILED, "the acquisition worker was killed by signal 9")
    assert row.verdict is not None and row.verdict.reasons == ("the acquisition died",)
    assert row.recording is not None and row.recording.frames > 1000
    assert_holds(keeping.captures.recording(capture_id), frames)
    assert not Path(f"/dev/shm/spiked-{capture_id}").exists()


def test_two_devices_at_once_and_one_capture_each(keeping: Keeping, tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 500)
    replay = f"replay:{tmp_path / 'noise.dat'}?repeat=1000"
    first = keeping.captures.start(recorded_only(replay))
    with pytest.raises(BusyError, match=first.id):
        keeping.captures.start(recorded_only(f"{replay}&pace=0.5"))
    second = keeping.captures.start(Plan(f"{SMALL}&pace=0", frames=400, options=ReconstructionOptions(steps=5)))
    done = over(keeping, second.id)
    assert done.row.state is CaptureState.COMPLETE
    assert done.row.recording is not None and done.row.recording.frames == 400
    assert not keeping.captures.get(first.id).row.state.over
    assert [snapshot.id for snapshot in keeping.captures.live()] == [first.id]
    keeping.captures.stop(first.id)
    assert over(keeping, first.id).row.state is CaptureState.COMPLETE
    third = keeping.captures.start(recorded_only(replay, frames=100))
    assert over(keeping, third.id).row.recording is not None


def test_a_capture_that_does_nothing_is_refused(keeping: Keeping) -> None:
    with pytest.raises(ConfigurationError, match="does nothing"):
        keeping.captures.start(Plan(SMALL, record=False, reconstruct=False))
    with pytest.raises(ConfigurationError, match="not armed"):
        keeping.captures.start(Plan(SMALL, pretrigger_s=0.1))
    with pytest.raises(UnknownIdError):
        keeping.captures.get("nothing")
    assert keeping.captures.list().items == []


def test_names_and_notes_change_while_it_runs_and_after(keeping: Keeping, tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 100)
    capture_id = keeping.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=1000")).id
    keeping.captures.update(capture_id, name="while it runs")
    with pytest.raises(BusyError, match="stop it first"):
        keeping.captures.remove(capture_id)
    keeping.captures.stop(capture_id)
    assert over(keeping, capture_id).row.name == "while it runs"
    keeping.captures.update(capture_id, notes="after", keep=True)
    row = keeping.catalogue.captures.get(capture_id)
    assert (row.name, row.notes, row.keep) == ("while it runs", "after", True)
    keeping.captures.remove(capture_id)
    assert keeping.captures.list().items == []
    assert keeping.captures.restore(capture_id).row.deleted_at is None
    assert keeping.captures.list().items[0].id == capture_id


def test_an_armed_device_begins_in_the_past(keeping: Keeping, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    source = f"replay:{tmp_path / 'noise.dat'}?repeat=100000"
    keeping.captures.arm(source, 0.2)
    with pytest.raises(BusyError, match="armed already"):
        keeping.captures.arm(source, 0.2)
    standby = next(iter(keeping.captures.armed().values()))
    wait_for(lambda: (counters := standby.counters()) and counters.next_frame > 12_000, "the ring fills")
    with pytest.raises(ConfigurationError, match=r"keeps 0\.2 s"):
        keeping.captures.start(recorded_only(source, pretrigger_s=0.3))
    counters = standby.counters()
    assert counters is not None
    before = counters.next_frame
    capture_id = keeping.captures.start(recorded_only(source, pretrigger_s=0.2, frames=2000)).id
    assert keeping.captures.armed() == {}
    row = over(keeping, capture_id).row
    assert row.state is CaptureState.COMPLETE, row.reason
    assert row.recording is not None and row.recording.frames == 6000, row.verdict
    assert row.verdict is not None and row.verdict.grade is Grade.GOOD
    recording = open_recording(keeping.captures.recording(capture_id))
    shifts = [shift for shift in range(997) if (recording.data[:1] == frames[shift]).all()]
    assert len(shifts) == 1
    assert ((recording.data == frames[(shifts[0] + np.arange(6000)) % 997]).all(axis=1)).all()
    assert row.counters is not None and row.counters.next_frame >= before + 2000


def test_a_device_is_disarmed(keeping: Keeping) -> None:
    keeping.captures.arm(SMALL, 0.1)
    wait_for(lambda: len(children()) >= 4, "workers stand by")
    keeping.captures.disarm(SMALL)
    assert keeping.captures.armed() == {}
    wait_for(lambda: children() == [], "they have left")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 24 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=24m", "spiked-test", str(place)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small file system is not permitted here")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def test_a_full_disk_closes_the_capture_and_the_service_lives(small_disk: Path, tmp_path: Path) -> None:
    sensor = Sensor(400, 250, 20_000.0)
    frames = random_recording(tmp_path / "noise.dat", 500, sensor)
    plan = recorded_only(f"replay:{tmp_path / 'noise.dat'}?pace=0&repeat=1000")
    with kept(small_disk) as keeping:
        capture_id = keeping.captures.start(plan).id
        row = over(keeping, capture_id).row
        assert row.state is CaptureState.COMPLETE
        assert "the disk is full" in row.reason
        assert row.recording is not None and row.recording.frames > 1000
        assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
        assert_holds(keeping.captures.recording(capture_id), frames)
        assert open_recording(keeping.captures.recording(capture_id)).warnings == ()
        keeping.captures.purge(capture_id)
        again = over(keeping, keeping.captures.start(recorded_only(plan.source, frames=100)).id).row
        assert again.verdict is not None and again.verdict.grade is Grade.GOOD


def test_a_disk_gone_read_only_is_survived_and_made_up_for(small_disk: Path, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 500)
    with kept(small_disk) as keeping:
        capture_id = keeping.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=1000")).id
        wait_for(lambda: received(keeping, capture_id) > 1000, "frames come")
        subprocess.run(["mount", "-o", "remount,size=1k", str(small_disk)], check=False, capture_output=True)
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=False, capture_output=True)
        with (small_disk / "others").open("wb") as file:
            try:
                while True:
                    file.write(bytes(1 << 16))
                    file.flush()
            except OSError:
                pass
        row = over(keeping, capture_id).row
        assert row.recording is not None and row.recording.frames > 1000
        assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
        (small_disk / "others").unlink()
        keeping.captures.retry_saving()
        assert keeping.catalogue.captures.get(capture_id).state.over
        assert_holds(keeping.captures.recording(capture_id), frames)


def test_a_capture_that_cannot_be_recorded_at_all_fails_and_says_so(keeping: Keeping, tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 500)
    plan = recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=1000")
    before = keeping.folder.recording

    def blocked(capture_id: str) -> Path:
        return before(capture_id).parent / "logs" / "no" / "such" / "recording.dat"

    keeping.folder.recording = blocked  # type: ignore[method-assign]
    row = over(keeping, keeping.captures.start(plan).id).row
    assert row.state is CaptureState.FAILED
    assert "cannot be written" in row.reason
    assert row.verdict is not None and row.verdict.grade is Grade.BAD


def test_stopping_twice_cuts_the_refinement(keeping: Keeping) -> None:
    plan = Plan(f"{SMALL}&pace=0", frames=600, options=ReconstructionOptions(steps=200_000))
    capture_id = keeping.captures.start(plan).id
    wait_for(lambda: keeping.captures.get(capture_id).row.state is CaptureState.FINISHING, "the source ends")
    job = keeping.captures.get(capture_id).reconstructions[0]
    wait_for(lambda: keeping.reconstructions.get(job.id).stage in ("refining", "done"), "it refines")
    keeping.captures.stop(capture_id)
    done = over(keeping, capture_id)
    assert done.row.state is CaptureState.COMPLETE
    assert done.reconstructions[0].state is JobState.COMPLETE
    assert done.reconstructions[0].progress < 1


def test_the_service_ends_within_a_moment_and_closes_the_recording(tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 500)
    with kept(tmp_path / "data") as keeping:
        capture_id = keeping.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=1000")).id
        wait_for(lambda: received(keeping, capture_id) > 1000, "frames come")
        begin = time.monotonic()
    assert time.monotonic() - begin < 10
    with kept(tmp_path / "data") as keeping:
        row = keeping.captures.get(capture_id).row
        assert (row.state, row.reason) == (CaptureState.COMPLETE, "ended, because the service was")
        assert row.verdict is not None and row.verdict.grade is Grade.GOOD
        assert_holds(keeping.captures.recording(capture_id), frames)


def test_a_reconstruction_that_cannot_be_begun_leaves_the_recording(
    keeping: Keeping, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeping.folder, "reconstruction", lambda _: tmp_path / "no" / "such")
    capture_id = keeping.captures.start(Plan(f"{SMALL}&pace=0")).id
    row = over(keeping, capture_id).row
    assert row.state is CaptureState.FAILED
    assert "cannot be started" in row.reason
    assert row.verdict is not None
    assert keeping.reconstructions.counts()[JobState.RUNNING] == 0
