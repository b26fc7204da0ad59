"""The service killed at any moment: what the next one finds, makes whole, and takes up again."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from spiked_service.store.rows import CaptureState, Grade, JobState, Plan
from waiting import until

from spiked.recording import open_recording, verify

from .survival import SMALL, assert_holds, jobs_of, kept, over, random_recording, received

SHM = Path("/dev/shm")
_SERVICE = """
import sys
from pathlib import Path
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.events.bus import Bus
from spiked_service.settings.settings import LogFormat, LogLevel
from spiked_service.daemon import open_data_store
from spiked_service.events.logging import configure_logs
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import Plan
configure_logs(LogLevel.INFO, LogFormat.JSON)
data_store = open_data_store(Path(sys.argv[1]), BusNotifier(Bus()))
for source in sys.argv[2:]:
    live = source.startswith("sim:")
    plan = Plan(source, reconstruct=live, options=ReconstructionOptions(steps=5))
    print(data_store.captures.start(plan).id, flush=True)
for line in sys.stdin:
    for snapshot in data_store.captures.live():
        print(snapshot.id, snapshot.counters.received if snapshot.counters else 0, end=";")
    print(flush=True)
"""


class Service:
    """A service in a process of its own, with a capture of each source."""

    def __init__(self, data: Path, *sources: str) -> None:
        command = [sys.executable, "-c", _SERVICE, str(data), *sources]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdin is not None and self.process.stdout is not None
        self._asks, self._answers = self.process.stdin, self.process.stdout
        self.ids = [self._answers.readline().strip() for _ in sources]

    def received(self) -> dict[str, int]:
        """Frames that have come, by capture."""
        print(file=self._asks, flush=True)
        pairs = [part.split() for part in self._answers.readline().strip().split(";") if part]
        return {key: int(count) for key, count in pairs}

    def kill(self) -> None:
        """Kill the service alone, and see that no worker stays."""
        workers = psutil.Process(self.process.pid).children()
        self.process.kill()
        self.process.wait()
        assert psutil.wait_procs(workers, 60)[1] == []
        self._asks.close()
        self._answers.close()


@contextmanager
def service(data: Path, *sources: str) -> Iterator[Service]:
    one = Service(data, *sources)
    try:
        yield one
    finally:
        if one.process.poll() is None:
            one.kill()


def unfinished(data: Path) -> list[Path]:
    """Files that no finished thing has."""
    return [*data.rglob("*.part"), *data.rglob(".*.removed")]


def test_after_a_kill_recordings_are_whole_and_jobs_are_taken_up(tmp_path: Path) -> None:
    frames = random_recording(tmp_path / "noise.dat", 997)
    data = tmp_path / "data"
    with service(data, SMALL, f"replay:{tmp_path / 'noise.dat'}?repeat=9999") as one:
        live, record = one.ids
        until(lambda: min([*one.received().values(), 999]) > 600, "frames come to both")
        before = one.received()[record]
        one.kill()
    path = data / "captures" / record / "recording.dat"

    with kept(data) as data_store:
        row = over(data_store, record).row
        assert (row.state, row.reason) == (CaptureState.FAILED, "the service ended during the capture")
        assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
        assert row.recording is not None and row.recording.frames + row.recording.lost > before - 1000
        assert open_recording(path).warnings == ()
        assert open_recording(path).frames == row.recording.frames
        assert_holds(path, frames)
        assert "as they were written" not in str(verify(path).reasons)
        assert not any((SHM / f"spiked-{key}").exists() for key in (live, record))
        until(lambda: jobs_of(data_store, live)[0].state.over, "taken up again")
        snapshot = data_store.captures.get(live)
        job = jobs_of(data_store, snapshot.id)[0]
        assert (job.live, job.attempts) == (False, 2)
        assert snapshot.row.recording is not None and job.frames == snapshot.row.recording.frames
        assert data_store.captures.list().items[0].id == record
    assert unfinished(data) == []


def test_a_job_without_a_recording_fails_honestly_after_a_kill(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with kept(data) as data_store:
        capture_id = data_store.captures.start(Plan(SMALL, record=False)).id
        until(lambda: received(data_store, capture_id) > 100, "frames come")
        row = jobs_of(data_store, capture_id)[0]
        # As a kill would leave it: the row says that it runs, and nothing of the capture's end is noted.
        data_store.catalogue.reconstructions.put(row)
        capture = data_store.captures.get(capture_id).row
        data_store.captures.stop(capture_id)
        data_store.captures.stop(capture_id)
        over(data_store, capture_id)
        data_store.catalogue.captures.put(capture)
        data_store.catalogue.reconstructions.put(row)
    with kept(data) as data_store:
        until(lambda: data_store.reconstructions.rows.get(row.id).state is JobState.FAILED, "it is told")
        assert "because the service ended while it ran" in data_store.reconstructions.rows.get(row.id).reason
        assert data_store.captures.get(capture_id).row.state is CaptureState.FAILED


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_any_process_killed_at_any_moment(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    frames = random_recording(tmp_path / "noise.dat", 997)
    data = tmp_path / "data"
    with service(data, f"replay:{tmp_path / 'noise.dat'}?repeat=9999") as one:
        capture_id = one.ids[0]
        time.sleep(chance.random() * 2)
        workers = psutil.Process(one.process.pid).children()
        for victim in chance.sample(workers, min(len(workers), chance.randrange(3))):
            os.kill(victim.pid, signal.SIGKILL)
            time.sleep(chance.random())
        one.kill()
    with kept(data) as data_store:
        row = over(data_store, capture_id).row
        if row.verdict is None:  # acquisition was killed before the camera was open
            assert (row.state, row.recording) == (CaptureState.FAILED, None) and "killed" in row.reason, row
        path = data_store.captures.recording(capture_id)
        if row.recording is not None and row.recording.frames:
            assert open_recording(path).warnings == ()
            assert_holds(path, frames)
        assert not (SHM / f"spiked-{capture_id}").exists()
    assert unfinished(data) == []
