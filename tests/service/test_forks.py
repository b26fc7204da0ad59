"""Workers that are forked from a process that has imported their role."""

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue

import psutil
import pytest
from spiked_service.workers.forks import ForkedWorkers
from spiked_service.workers.messages import AcquisitionCommand, Role, WorkerEvent
from spiked_service.workers.process import WorkerProcess
from waiting import until

from spiked.ring import clean_stale


@pytest.fixture
def forks() -> Iterator[ForkedWorkers]:
    """Of the role that is imported fastest."""
    one = ForkedWorkers(Role.ACQUISITION)
    yield one
    one.close()
    clean_stale()


def servers() -> list[psutil.Process]:
    """Servers that this process has started."""
    return [one for one in psutil.Process().children() if "--forks" in one.cmdline()]


def alive(pid: int) -> bool:
    """Whether a process runs."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


class Run:
    """A worker that was forked, and what it has told."""

    def __init__(self, forks: ForkedWorkers, folder: Path) -> None:
        command = AcquisitionCommand(
            source="sim:?width=96&height=64",
            ring_id=f"test-fork-{os.urandom(4).hex()}",
            frames=None,
            seconds=None,
            consumers=1,
            history_s=0,
        )
        self.events: list[WorkerEvent] = []
        self.exits: SimpleQueue[str | None] = SimpleQueue()
        self.log = folder / f"log {command.ring_id}"
        standby = forks.standby(self.log)
        self.worker = WorkerProcess(command, self.log, self.events.append, self.exits.put, standby)

    def exit(self) -> str | None:
        return self.exits.get(timeout=60)


def test_workers_of_one_server_run_and_report(forks: ForkedWorkers, tmp_path: Path) -> None:
    runs = [Run(forks, tmp_path) for _ in range(3)]
    assert len({one.worker.pid for one in runs}) == 3
    for one in runs:
        until(lambda one=one: one.events, "it acquires frames")
        one.worker.stop()
    assert [one.exit() for one in runs] == [None] * 3
    (server,) = servers()
    assert server.children() == []


def test_a_killed_worker_is_reported_and_others_go_on(forks: ForkedWorkers, tmp_path: Path) -> None:
    killed, other = Run(forks, tmp_path), Run(forks, tmp_path)
    os.kill(killed.worker.pid, signal.SIGKILL)
    assert killed.exit() == "the acquisition worker was killed by signal 9"
    assert psutil.Process(other.worker.pid).is_running()
    other.worker.stop()
    assert other.exit() is None


def test_a_worker_that_does_not_leave_is_killed_with_its_group(forks: ForkedWorkers, tmp_path: Path) -> None:
    standby = forks.standby(tmp_path / "log")
    process = psutil.Process(standby.process.pid)
    assert os.getpgid(process.pid) == process.pid
    os.kill(process.pid, signal.SIGSTOP)
    standby.kill_after(0.1)
    assert standby.process.poll() == -signal.SIGKILL
    with pytest.raises(subprocess.TimeoutExpired):
        forks.standby(tmp_path / "log").process.wait(0.01)


def test_workers_die_with_their_server_and_the_next_has_a_new_one(forks: ForkedWorkers, tmp_path: Path) -> None:
    lost = Run(forks, tmp_path)
    (server,) = servers()
    server.kill()
    assert lost.exit() == "the acquisition worker was killed by signal 9"
    until(lambda: not alive(lost.worker.pid), "the worker has died with it")
    other = Run(forks, tmp_path)
    other.worker.stop()
    assert other.exit() is None


def test_a_server_whose_modules_cannot_be_imported_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "numpy.py").write_text("raise ImportError('there is none')")
    forks = ForkedWorkers(Role.ACQUISITION)
    with pytest.raises(OSError, match="the process that forks it has ended"):
        forks.standby(tmp_path / "log")
    forks.close()


def test_closing_ends_the_workers(tmp_path: Path) -> None:
    forks = ForkedWorkers(Role.ACQUISITION)
    run = Run(forks, tmp_path)
    closed = threading.Thread(target=forks.close)
    closed.start()
    assert run.exit() is not None
    closed.join()
    assert servers() == []
    clean_stale()
