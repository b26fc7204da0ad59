"""Captures: recorded as they were, several at once, graded, and closed cleanly whatever their workers and disk do."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from spiked_service.base.errors import BusyError
from spiked_service.base.health import CheckStatus, Health
from spiked_service.captures.archive import DataStore
from spiked_service.events.bus import Bus
from spiked_service.operations.metrics import Metrics
from spiked_service.operations.metrics_sources import metrics_source_of
from spiked_service.reconstructions.job_runner import begun_anew
from spiked_service.results.published import Published
from spiked_service.results.versions import pose_file, versions
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import StoreError, UnknownIdError
from spiked_service.store.disk_space import DiskFullError
from spiked_service.store.rows import CaptureState, ConsumerCounters, Grade, JobState, Plan, Stage
from spiked_service.workers.backoff import Backoff
from spiked_service.workers.messages import Role
from spiked_service.workers.process import StandbyWorker
from waiting import until

from spiked.errors import ConfigurationError
from spiked.poses import PoseFile
from spiked.recon import Reconstructor
from spiked.recording import RecordingWriter, open_recording, verify
from spiked.ring import LossCause
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor

from ..small_disk import small_disk
from .survival import (
    SENSOR,
    SMALL,
    assert_holds,
    children,
    jobs_of,
    kept,
    moving_recording,
    over,
    random_recording,
    received,
)


@pytest.fixture
def data_store(tmp_path: Path) -> Iterator[DataStore]:
    with kept(tmp_path / "data") as one:
        yield one
    until(lambda: children() == [], "every worker has left")


def recorded_only(source: str, **more: object) -> Plan:
    return Plan(source, reconstruct=False, **more)  # type: ignore[arg-type]


def test_a_recording_holds_what_the_source_gave(data_store: DataStore, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 1000)
    plan = recorded_only(f"replay:{tmp_path / 'noise.dat'}?pace=0.1", name="noise", notes="by hand")
    started = data_store.captures.start(plan)
    done = over(data_store, started.id)
    row = done.row
    assert (row.state, row.reason, row.warnings) == (CaptureState.COMPLETE, "", ())
    assert (row.name, row.notes, row.frames_planned) == ("noise", "by hand", 1000)
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (1000, 0)
    assert row.recording.bytes == frames.nbytes
    assert row.verdict is not None and row.verdict.grade is Grade.GOOD
    assert jobs_of(data_store, done.id) == []
    path = data_store.captures.recording(row.id)
    assert path.read_bytes() == frames.tobytes()
    checked = verify(path)
    assert (checked.verdict, checked.reasons) == ("good", ())
    assert len(checked.recording.clock) >= 1
    assert data_store.folder.thumbnail(row.id).read_bytes().startswith(b"RIFF")
    assert data_store.captures.picture(row.id) is not None


def test_frames_the_source_lost_are_gaps_of_the_recording(data_store: DataStore, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 600)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=0&gap=100:7&gap=300:50:device"
    row = over(data_store, data_store.captures.start(recorded_only(source)).id).row
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (543, 57)
    assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
    assert row.verdict.reasons == ("57 of 600 frames were lost (device 50, usb 7)",)
    assert_holds(data_store.captures.recording(row.id), frames)
    assert [(gap.first, gap.count) for gap in open_recording(data_store.captures.recording(row.id)).gaps] == [
        (100, 7),
        (300, 50),
    ]


def test_a_killed_recorder_is_followed_and_nothing_is_lost(data_store: DataStore, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=1&repeat=1000"
    capture_id = data_store.captures.start(recorded_only(source)).id
    for kills in range(2):
        until(lambda: received(data_store, capture_id) > 20_000 * (kills + 1), "frames come")  # noqa: B023
        pid = data_store.captures.processes()[capture_id]["recorder"]
        os.kill(pid, signal.SIGKILL)
        until(lambda: data_store.captures.processes()[capture_id].get("recorder", pid) != pid, "another")  # noqa: B023
    until(lambda: received(data_store, capture_id) > 60_000, "frames come")
    data_store.captures.stop(capture_id)
    row = over(data_store, capture_id).row
    assert row.state is CaptureState.COMPLETE
    assert (
        list(row.warnings)
        == ["the recorder worker was killed by signal 9; it was restarted and continues where it stopped"] * 2
    )
    assert row.recording is not None and row.counters is not None
    assert row.recording.frames + row.recording.lost == row.counters.next_frame
    assert_holds(data_store.captures.recording(capture_id), frames)
    assert row.recording.lost == 0, row.verdict


def test_a_recorder_killed_behind_the_last_frame_is_followed_to_the_end(data_store: DataStore, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=1&repeat=1000"
    capture_id = data_store.captures.start(recorded_only(source, frames=6000)).id
    until(lambda: received(data_store, capture_id) > 500, "frames come")
    recorder = psutil.Process(data_store.captures.processes()[capture_id]["recorder"])
    recorder.suspend()
    until(lambda: "acquisition" not in data_store.captures.processes()[capture_id], "all frames came")
    recorder.kill()
    row = over(data_store, capture_id).row
    assert row.state is CaptureState.COMPLETE
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (6000, 0)
    assert_holds(data_store.captures.recording(capture_id), frames)
    assert not Path(f"/dev/shm/spiked-{capture_id}").exists()


def test_what_came_after_the_last_of_many_killed_recorders_is_told_as_lost(
    data_store: DataStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spiked_service.workers.supervisor.Backoff", lambda: Backoff((0.0,)))
    frames = random_recording(tmp_path / "noise.dat", 997)
    capture_id = data_store.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?pace=1&repeat=1000")).id
    until(lambda: received(data_store, capture_id) > 500, "frames come")
    pid = 0
    for _ in range(2):
        until(
            lambda: data_store.captures.processes()[capture_id].get("recorder", pid) != pid,  # noqa: B023
            "a recorder is there",
        )
        pid = data_store.captures.processes()[capture_id]["recorder"]
        os.kill(pid, signal.SIGKILL)
    row = over(data_store, capture_id).row
    assert (row.state, row.reason) == (
        CaptureState.FAILED,
        "the recorder worker was killed by signal 9, repeatedly",
    )
    assert row.recording is not None and row.counters is not None and row.recording.lost > 0
    assert row.recording.frames + row.recording.lost == row.counters.next_frame
    told = f"the last {row.recording.lost} of {row.counters.next_frame} frames were not recorded"
    assert row.verdict is not None and row.verdict.reasons[-1] == told
    recording = open_recording(data_store.captures.recording(capture_id))
    assert [(gap.first, gap.count) for gap in recording.gaps] == [(row.recording.frames, row.recording.lost)]
    assert_holds(recording.path, frames)


def test_a_reconstruction_killed_before_it_reads_holds_nobody_up(data_store: DataStore, tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 500)
    capture_id = data_store.captures.start(Plan(f"replay:{tmp_path / 'noise.dat'}?repeat=10")).id
    until(lambda: jobs_of(data_store, capture_id), "the reconstruction begins")
    job = jobs_of(data_store, capture_id)[0]
    os.kill(data_store.reconstructions.processes()[job.id], signal.SIGKILL)
    row = over(data_store, capture_id).row
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (5000, 0)


@pytest.mark.parametrize("halted", [False, True])
def test_a_capture_stopped_while_the_camera_is_absent_ends_and_says_so(data_store: DataStore, halted: bool) -> None:
    capture_id = data_store.captures.start(Plan("usb0?fov=40")).id
    states = set()

    def waits() -> bool:
        states.add(data_store.captures.get(capture_id).row.state)
        return CaptureState.WAITING in states

    until(lambda: "acquisition" in data_store.captures.processes()[capture_id], "the acquisition begins")
    if halted:
        acquisition = psutil.Process(data_store.captures.processes()[capture_id]["acquisition"])
        acquisition.suspend()
        time.sleep(1)
        acquisition.resume()
    until(waits, "it waits for the camera")
    assert data_store.captures.get(capture_id).reason == "the camera usb0 is not there: waiting for it"
    data_store.captures.stop(capture_id)
    done = over(data_store, capture_id)
    assert (done.row.state, done.row.reason) == (CaptureState.COMPLETE, "no frames: the camera was absent")
    job = jobs_of(data_store, done.id)[0]
    assert (job.state, job.reason) == (
        JobState.CANCELLED,
        "no frames were received, so there is nothing to reconstruct",
    )
    assert CaptureState.STREAMING not in states


@pytest.mark.parametrize("after_s", [0.0, 0.5, 1.5])
def test_a_capture_stopped_while_it_starts_ends_and_says_so(data_store: DataStore, after_s: float) -> None:
    capture_id = data_store.captures.start(Plan("usb0?fov=40")).id
    time.sleep(after_s)
    data_store.captures.stop(capture_id)
    done = over(data_store, capture_id)
    assert done.row.state is CaptureState.COMPLETE
    assert done.row.reason in ("no frames: the camera was absent", "no frames: it was stopped before the first frame")
    assert all(job.state is JobState.CANCELLED for job in jobs_of(data_store, done.id))


def test_states_are_updated_again_after_the_catalogue_could_not_be_read(
    data_store: DataStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random_recording(tmp_path / "noise.dat", 100)
    capture_id = data_store.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=10000")).id
    read, ticks = data_store.catalogue.newest_jobs, 0

    def fails_once(*asked: Any) -> Any:
        nonlocal ticks
        if threading.current_thread().name == "counters":
            ticks += 1
            if ticks == 1:
                raise StoreError("the catalogue cannot be read: disk I/O error")
        return read(*asked)

    monkeypatch.setattr(data_store.catalogue, "newest_jobs", fails_once)
    until(lambda: ticks > 2, "the thread that updates the states continues")
    data_store.captures.stop(capture_id)
    assert over(data_store, capture_id).row.state is CaptureState.COMPLETE


def test_workers_take_no_module_from_where_the_service_was_started(
    data_store: DataStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = tmp_path / "hostile"
    hostile.mkdir()
    for name in ("secrets", "json", "numpy", "cv2", "spiked"):
        (hostile / f"{name}.py").write_text(
            f"open({str(tmp_path / 'executed')!r}, 'a').write({name!r})\nraise SystemExit(3)"
        )
    monkeypatch.chdir(hostile)
    done = over(data_store, data_store.captures.start(Plan(f"{SMALL}&pace=0", frames=200)).id)
    assert not (tmp_path / "executed").exists()
    assert done.row.state is CaptureState.COMPLETE, done.row.reason


def test_a_source_that_waits_waits_for_the_successor_of_a_killed_recorder(
    data_store: DataStore, tmp_path: Path
) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=0&repeat=300"
    capture_id = data_store.captures.start(recorded_only(source)).id
    until(lambda: received(data_store, capture_id) > 500, "frames come")
    os.kill(data_store.captures.processes()[capture_id]["recorder"], signal.SIGKILL)
    row = over(data_store, capture_id).row
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (997 * 300, 0)
    assert row.verdict is not None and row.verdict.grade is Grade.GOOD
    assert_holds(data_store.captures.recording(capture_id), frames)


def test_a_disk_that_stalls_costs_frames_that_are_told(data_store: DataStore, tmp_path: Path) -> None:
    sensor = Sensor(400, 250, 20_000.0)
    frames = random_recording(tmp_path / "noise.dat", 500, sensor)
    source = f"replay:{tmp_path / 'noise.dat'}?pace=0.5&repeat=1000"
    capture_id = data_store.captures.start(recorded_only(source)).id
    until(lambda: received(data_store, capture_id) > 2_000, "frames come")
    recorder = psutil.Process(data_store.captures.processes()[capture_id]["recorder"])
    recorder.suspend()
    before = received(data_store, capture_id)
    until(lambda: received(data_store, capture_id) > before + 12_000, "more than the ring holds has come")
    recorder.resume()
    data_store.captures.stop(capture_id)
    row = over(data_store, capture_id).row
    assert row.state is CaptureState.COMPLETE
    assert row.recording is not None and row.counters is not None and row.verdict is not None
    assert row.recording.lost > 0
    assert row.recording.frames + row.recording.lost == row.counters.next_frame
    assert row.verdict.grade is Grade.DEGRADED and "(disk " in row.verdict.reasons[0]
    assert_holds(data_store.captures.recording(capture_id), frames)


def test_a_killed_acquisition_leaves_a_recording(data_store: DataStore, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 500)
    source = f"replay:{tmp_path / 'noise.dat'}?repeat=1000"
    capture_id = data_store.captures.start(recorded_only(source)).id
    until(lambda: received(data_store, capture_id) > 1000, "frames come")
    os.kill(data_store.captures.processes()[capture_id]["acquisition"], signal.SIGKILL)
    row = over(data_store, capture_id).row
    assert (row.state, row.reason) == (CaptureState.FAILED, "the acquisition worker was killed by signal 9")
    assert row.verdict is not None and row.verdict.reasons == ("the acquisition died",)
    assert row.recording is not None and row.recording.frames > 1000
    assert_holds(data_store.captures.recording(capture_id), frames)
    assert not Path(f"/dev/shm/spiked-{capture_id}").exists()


def test_two_devices_at_once_and_one_capture_each(data_store: DataStore, tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 500)
    replay = f"replay:{tmp_path / 'noise.dat'}?repeat=1000"
    first = data_store.captures.start(recorded_only(replay))
    with pytest.raises(BusyError, match=first.id):
        data_store.captures.start(recorded_only(f"{replay}&pace=0.5"))
    second = data_store.captures.start(Plan(f"{SMALL}&pace=0", frames=400, options=ReconstructionOptions(steps=5)))
    done = over(data_store, second.id)
    assert done.row.state is CaptureState.COMPLETE
    assert done.row.recording is not None and done.row.recording.frames == 400
    assert not data_store.captures.get(first.id).row.state.over
    assert [snapshot.id for snapshot in data_store.captures.live()] == [first.id]
    data_store.captures.stop(first.id)
    assert over(data_store, first.id).row.state is CaptureState.COMPLETE
    third = data_store.captures.start(recorded_only(replay, frames=100))
    assert over(data_store, third.id).row.recording is not None


def test_no_more_devices_are_in_use_than_may_be(data_store: DataStore, tmp_path: Path) -> None:
    data_store.captures.limit = 2
    random_recording(tmp_path / "noise.dat", 100)
    source = f"replay:{tmp_path / 'noise.dat'}?repeat=10000"
    first = data_store.captures.start(recorded_only(source))
    data_store.captures.arm(SMALL, 0.1)
    told = "2 devices are in use, 2 are allowed: stop a capture, disarm a device, or raise .* limit_captures"
    for refused in (
        lambda: data_store.captures.start(recorded_only("sim:?seed=3")),
        lambda: data_store.captures.arm("sim:?seed=3", 0.1),
    ):
        with pytest.raises(BusyError, match=told):
            refused()
    data_store.captures.stop(first.id)
    over(data_store, first.id)
    data_store.captures.disarm(SMALL)
    again = data_store.captures.start(recorded_only(f"{SMALL}&pace=0", frames=40))
    assert over(data_store, again.id).row.state is CaptureState.COMPLETE


BROKEN_IMPORT = """
import sys

class Broken:
    def find_spec(self, name, path=None, target=None):
        if name == "spiked_driver":
            raise ZeroDivisionError("deep inside")

sys.meta_path.insert(0, Broken())  # before the finder of an editable installation
"""


def test_a_worker_that_fails_unexpectedly_is_told_of_without_its_traceback(
    data_store: DataStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random_recording(tmp_path / "noise.dat", 100)
    before = StandbyWorker.__init__

    def broken(standby: StandbyWorker, role: Role, log: Path) -> None:
        monkeypatch.setenv("PYTHONPATH", str(tmp_path / "broken"))
        before(standby, role, log)

    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "sitecustomize.py").write_text(BROKEN_IMPORT)
    monkeypatch.setattr(StandbyWorker, "__init__", broken)
    row = over(data_store, data_store.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}")).id).row
    log = data_store.folder.capture(row.id) / "logs" / "acquisition.log"
    assert row.reason == f"the acquisition worker failed unexpectedly; see {log}"
    assert "ZeroDivisionError: deep inside" in log.read_text()


def test_a_capture_that_does_nothing_is_refused(data_store: DataStore) -> None:
    with pytest.raises(ConfigurationError, match="neither record nor reconstruct"):
        data_store.captures.start(Plan(SMALL, record=False, reconstruct=False))
    with pytest.raises(ConfigurationError, match="not armed"):
        data_store.captures.start(Plan(SMALL, pretrigger_s=0.1))
    with pytest.raises(UnknownIdError):
        data_store.captures.get("nothing")
    assert data_store.captures.list().items == []


def test_names_and_notes_change_while_it_runs_and_after(data_store: DataStore, tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 100)
    capture_id = data_store.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=1000")).id
    data_store.captures.update(capture_id, name="while it runs")
    with pytest.raises(BusyError, match="stop it first"):
        data_store.captures.removal.remove(capture_id)
    data_store.captures.stop(capture_id)
    assert over(data_store, capture_id).row.name == "while it runs"
    data_store.captures.update(capture_id, notes="after", keep=True)
    row = data_store.catalogue.captures.get(capture_id)
    assert (row.name, row.notes, row.keep) == ("while it runs", "after", True)
    data_store.captures.removal.remove(capture_id)
    assert data_store.captures.list().items == []
    assert data_store.captures.removal.restore(capture_id).row.deleted_at is None
    assert data_store.captures.list().items[0].id == capture_id


def test_an_armed_device_begins_in_the_past(data_store: DataStore, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    source = f"replay:{tmp_path / 'noise.dat'}?repeat=100000&gap=20:9"
    data_store.captures.arm(source, 0.2)
    with pytest.raises(BusyError, match="armed already"):
        data_store.captures.arm(source, 0.2)
    armed_device = next(iter(data_store.captures.armed().values()))
    until(lambda: (counters := armed_device.counters()) and counters.next_frame > 12_000, "the ring fills")
    with pytest.raises(ConfigurationError, match=r"keeps 0\.2 s"):
        data_store.captures.start(recorded_only(source, pretrigger_s=0.3))
    counters = armed_device.counters()
    assert counters is not None
    before = counters.next_frame
    capture_id = data_store.captures.start(recorded_only(source, pretrigger_s=0.2, frames=12_000)).id
    assert data_store.captures.armed() == {}

    def recorder() -> ConsumerCounters | None:
        counters = data_store.captures.get(capture_id).counters
        consumers = {} if counters is None else {one.name: one for one in counters.consumers}
        return consumers.get("recorder")

    until(lambda: (one := recorder()) and one.frames_read > 0, "it is recorded")
    assert (one := recorder()) is not None and one.lost == 0
    row = over(data_store, capture_id).row
    assert row.state is CaptureState.COMPLETE, row.reason
    assert row.recording is not None and row.recording.frames == 16_000, row.verdict
    assert row.verdict is not None and row.verdict.grade is Grade.GOOD
    recording = open_recording(data_store.captures.recording(capture_id))
    shifts = [shift for shift in range(997) if (recording.data[:1] == frames[shift]).all()]
    assert len(shifts) == 1
    assert ((recording.data == frames[(shifts[0] + np.arange(16_000)) % 997]).all(axis=1)).all()
    assert row.counters is not None and row.counters.next_frame >= before + 12_000
    # The capture has its own frames alone, and the metrics all that the ring had since it was armed.
    assert (row.counters.received, row.counters.lost["usb"]) == (16_000, 0)
    (ring,) = data_store.captures.rings()
    assert ring.over and ring.counters.lost["usb"] == 9
    assert ring.counters.received + 9 == ring.counters.next_frame >= row.counters.next_frame
    page = metrics_of(data_store)
    assert (
        f'spiked_frames_received_total{{device="replay:{tmp_path}/noise.dat"}} {float(ring.counters.received)}' in page
    )


def test_a_device_is_disarmed(data_store: DataStore) -> None:
    data_store.captures.arm(SMALL, 0.1)
    until(lambda: len(children()) >= 4, "workers stand by")
    data_store.captures.disarm(SMALL)
    assert data_store.captures.armed() == {}
    until(lambda: children() == [], "they have left")


@pytest.fixture(name="small_disk")
def make_small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 24 MiB."""
    with small_disk(tmp_path / "disk", 24) as place:
        yield place


def metrics_of(data_store: DataStore) -> str:
    """As Prometheus reads them."""
    source = metrics_source_of(
        data_store.captures, data_store.reconstructions, data_store.catalogue, data_store.folder.path
    )
    return Metrics(source, Bus(), Health(), {}).exposition().decode()


def lost_on_disk(data_store: DataStore) -> float:
    """`spiked_frames_lost_total{cause="disk"}`."""
    text = metrics_of(data_store)
    return sum(
        float(line.rpartition(" ")[2])
        for line in text.splitlines()
        if line.startswith("spiked_frames_lost_total{") and 'cause="disk"' in line
    )


@pytest.mark.parametrize("pace", ["0", "0.1"])
def test_a_disk_that_is_filled_during_a_capture_accounts_for_every_frame(
    small_disk: Path, tmp_path: Path, pace: str
) -> None:
    sensor = Sensor(400, 250, 20_000.0)
    frames = random_recording(tmp_path / "noise.dat", 300, sensor)
    source = f"replay:{tmp_path / 'noise.dat'}?pace={pace}&repeat=5&gap=20:9"
    filler = small_disk / "others"
    with kept(small_disk) as data_store:
        assert data_store.check_disk()[0] is not CheckStatus.FAILED
        started = data_store.captures.start(recorded_only(source))
        filler.write_bytes(bytes(14 << 20))
        row = over(data_store, started.id).row
        assert row.state is CaptureState.FAILED
        assert "the disk is full" in row.reason and "frames are safe" in row.reason
        assert row.recording is not None and row.counters is not None and row.recording.frames > 100
        disk = row.recording.lost_by_cause["disk"]
        assert disk > 0 and row.recording.lost_by_cause == {"usb": 9, "disk": disk}
        assert row.recording.frames + row.recording.lost == row.counters.next_frame
        assert row.recording.lost == 9 + disk
        assert lost_on_disk(data_store) == disk
        assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
        assert row.verdict.reasons[0] == row.reason and f"(disk {disk}, usb 9)" in row.verdict.reasons[1]
        path = data_store.captures.recording(row.id)
        assert_holds(path, frames)
        assert open_recording(path).warnings == ()
        assert sum(gap.count for gap in open_recording(path).gaps) == row.recording.lost
        assert str(verify(path).reasons) == f"('{row.recording.lost} frames were lost in 2 gaps',)"

        filler.write_bytes(bytes(filler.stat().st_size + data_store.disk_space.storable_bytes))
        assert data_store.check_disk()[0] is CheckStatus.FAILED
        for plan, needs in (
            (recorded_only(source), "this capture needs 19.8 MB"),
            (recorded_only(SMALL), "an unlimited capture needs"),
        ):
            with pytest.raises(DiskFullError, match=f"{needs}.* free for captures at {small_disk}"):
                data_store.captures.start(plan)
        assert len(data_store.captures.list().items) == 1
        filler.unlink()
        assert data_store.check_disk()[0] is not CheckStatus.FAILED
        data_store.captures.removal.purge(row.id)
        until(lambda: data_store.folder.purged() == set(), "its space is free")
        again = over(data_store, data_store.captures.start(recorded_only(source, frames=100)).id).row
        assert again.verdict is not None and again.state is CaptureState.COMPLETE


def test_a_replayed_loss_to_the_disk_is_counted_once(data_store: DataStore, tmp_path: Path) -> None:
    content = np.random.default_rng(0).integers(0, 256, (100, SENSOR.frame_bytes), np.uint8)
    with RecordingWriter(tmp_path / "full.dat", SENSOR) as writer:
        writer.append(content)
        writer.gap(100, 30, LossCause.DISK)
        writer.append(content)
    done = over(data_store, data_store.captures.start(recorded_only(f"replay:{tmp_path / 'full.dat'}?pace=max")).id)
    assert done.row.recording is not None and done.row.recording.lost_by_cause == {"disk": 30}
    assert done.counters is not None and done.counters.lost["disk"] == 30
    assert lost_on_disk(data_store) == 30


def test_a_disk_gone_read_only_is_survived_and_made_up_for(small_disk: Path, tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 500)
    with kept(small_disk) as data_store:
        capture_id = data_store.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=40&pace=0.1")).id
        until(lambda: received(data_store, capture_id) > 1000, "frames come")
        subprocess.run(["mount", "-o", "remount,size=1k", str(small_disk)], check=False, capture_output=True)
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=False, capture_output=True)
        with (small_disk / "others").open("wb") as file:
            try:
                while True:
                    file.write(bytes(1 << 16))
                    file.flush()
            except OSError:
                pass
        row = over(data_store, capture_id).row
        assert row.recording is not None and row.recording.frames > 1000
        assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
        (small_disk / "others").unlink()
        data_store.captures.retry_saving()
        assert data_store.catalogue.captures.get(capture_id).state.over
        assert_holds(data_store.captures.recording(capture_id), frames)


def fill_to_the_last_byte(disk: Path) -> Path:
    """A file that leaves no room at all on a small disk, not even for the catalogue."""
    filler = disk / "others"
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(1 << 16)):
            pass
    return filler


def test_a_job_whose_row_could_not_be_saved_begins_when_the_disk_has_room(
    small_disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spiked_service.captures.archive._CLEAN_S", 0.2)
    random_recording(tmp_path / "noise.dat", 500)
    with kept(small_disk) as data_store:
        done = over(data_store, data_store.captures.start(Plan(f"replay:{tmp_path / 'noise.dat'}?pace=0")).id)
        job = jobs_of(data_store, done.id)[0]
        assert job.state.over
        filler = fill_to_the_last_byte(small_disk)
        with pytest.raises(StoreError):
            while True:
                data_store.catalogue.reconstructions.put(job)
        with pytest.raises(StoreError):  # a user can ask again
            data_store.reconstructions.restart(job.id)
        assert data_store.reconstructions.rows.get(job.id) == job
        data_store.reconstructions.rows.save(begun_anew(job, job.options))  # as of a job whose worker was killed
        assert data_store.reconstructions.rows.get(job.id).state is JobState.QUEUED
        filler.unlink()
        until(lambda: data_store.reconstructions.rows.get(job.id).attempts > 0, "its worker begins")
        until(lambda: data_store.reconstructions.rows.get(job.id).state.over, "it ends")


def test_a_capture_that_cannot_be_recorded_at_all_fails_and_says_so(data_store: DataStore, tmp_path: Path) -> None:
    random_recording(tmp_path / "noise.dat", 500)
    plan = recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=1000")
    before = data_store.folder.recording

    def blocked(capture_id: str) -> Path:
        return before(capture_id).parent / "logs" / "no" / "such" / "recording.dat"

    data_store.folder.recording = blocked  # type: ignore[method-assign]
    row = over(data_store, data_store.captures.start(plan).id).row
    assert row.state is CaptureState.FAILED
    assert "cannot be written" in row.reason
    assert row.verdict is not None and row.verdict.grade is Grade.BAD


def test_stopping_twice_cuts_the_refinement(data_store: DataStore, tmp_path: Path) -> None:
    source = f"replay:{moving_recording(tmp_path / 'moving.dat')}?pace=0"
    plan = Plan(source, options=ReconstructionOptions(steps=200_000))
    capture_id = data_store.captures.start(plan).id
    until(lambda: data_store.captures.get(capture_id).row.state is CaptureState.FINISHING, "the source ends")
    job = jobs_of(data_store, capture_id)[0]
    until(lambda: data_store.reconstructions.rows.get(job.id).stage in ("refining", "done"), "it refines")
    data_store.captures.stop(capture_id)
    done = over(data_store, capture_id)
    assert done.row.state is CaptureState.COMPLETE
    assert jobs_of(data_store, done.id)[0].state is JobState.COMPLETE
    assert jobs_of(data_store, done.id)[0].progress < 1


def test_the_end_of_a_refinement_is_never_worse_than_what_was_there(data_store: DataStore, tmp_path: Path) -> None:
    """Ended at once, a refinement left splats that had just been seeded, and these were called complete."""
    source = f"replay:{moving_recording(tmp_path / 'moving.dat')}?pace=0"
    capture_id = data_store.captures.start(Plan(source, options=ReconstructionOptions(steps=200_000))).id
    until(lambda: data_store.captures.get(capture_id).row.state is CaptureState.FINISHING, "the source ends")
    job_id = jobs_of(data_store, capture_id)[0].id
    until(lambda: data_store.reconstructions.rows.get(job_id).stage == Stage.REFINING, "it refines")
    data_store.captures.stop(capture_id)
    row = jobs_of(data_store, over(data_store, capture_id).id)[0]
    assert row.state is JobState.COMPLETE and "the refinement was ended at" in row.reason
    folder = data_store.reconstructions.rows.folder(job_id)
    listed = versions(folder)
    assert [one.version for one in listed] == [one.version for one in data_store.reconstructions.rows.versions(job_id)]
    scorer = Reconstructor(open_recording(data_store.captures.recording(capture_id)).sensor)
    recording = open_recording(data_store.captures.recording(capture_id))
    scorer.feed(0, np.array(recording.read(0, recording.frames)))
    assert len(listed) > 1
    scene_psnr_db = [scored_db(scorer, folder, one) for one in listed]
    # The service compares versions on the views that it tracked live: these figures differ by up to 0.7 dB. Splats that
    # had just been seeded have less than half of the decibels.
    assert scene_psnr_db[-1] >= max(scene_psnr_db) - 1.0, scene_psnr_db
    assert (row.version, row.splats, row.psnr_db) == (listed[-1].version, listed[-1].splats, listed[-1].psnr_db)


def scored_db(scorer: Reconstructor, folder: Path, one: Published) -> float:
    """How like the recording a version looks."""
    assert one.intrinsics is not None
    poses = PoseFile(pose_file(folder, one))
    path = poses.trajectory(range(len(poses)))
    return scorer.scene_psnr_db(Scene.read_ply(folder / one.scene), path, Intrinsics(*one.intrinsics))


def test_the_service_ends_within_a_moment_and_closes_the_recording(tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 500)
    with kept(tmp_path / "data") as data_store:
        capture_id = data_store.captures.start(recorded_only(f"replay:{tmp_path / 'noise.dat'}?repeat=1000")).id
        until(lambda: received(data_store, capture_id) > 1000, "frames come")
        begin = time.monotonic()
    assert time.monotonic() - begin < 10
    with kept(tmp_path / "data") as data_store:
        row = data_store.captures.get(capture_id).row
        assert (row.state, row.reason) == (CaptureState.COMPLETE, "ended with the service")
        assert row.verdict is not None and row.verdict.grade is Grade.GOOD
        assert_holds(data_store.captures.recording(capture_id), frames)


def test_a_reconstruction_that_cannot_be_begun_leaves_the_recording(
    data_store: DataStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(data_store.folder, "reconstruction", lambda _: tmp_path / "no" / "such")
    capture_id = data_store.captures.start(Plan(f"{SMALL}&pace=0")).id
    row = over(data_store, capture_id).row
    assert row.state is CaptureState.FAILED
    assert "cannot be started" in row.reason
    assert row.verdict is not None
    assert data_store.reconstructions.rows.counts()[JobState.RUNNING] == 0
