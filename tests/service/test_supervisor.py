"""The supervisor of a worker: restarts after a death, and an end when there is no further restart."""

import errno
import os
import queue
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from spiked_service.workers.backoff import Backoff
from spiked_service.workers.messages import AcquisitionCommand, PreviewCommand, Role
from spiked_service.workers.process import StandbyWorker
from spiked_service.workers.supervisor import WorkerSupervisor
from waiting import until

from spiked.ring import clean_stale

from .survival import SMALL, children

NO_RING = PreviewCommand(capture_id="none", ring="no-such-ring", thumbnail=None)
"""Its worker exits with an error within a second."""
KILLED = "the preview worker was killed by signal 9"
EXIT_S = 120.0


class Owner:
    """Starts a supervised worker and keeps the reasons of its exits."""

    def __init__(self, log: Path, keep_standby: bool = False) -> None:
        self.exits: queue.Queue[str | None] = queue.Queue()
        self.supervisor = WorkerSupervisor(Role.PREVIEW, log, lambda event: None, self.exits.put, keep_standby)

    def kill(self) -> None:
        """Start a worker and kill it, so that a restart is due."""
        self.supervisor.start(NO_RING)
        pid = self.supervisor.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        assert self.exits.get(timeout=EXIT_S) == KILLED
        assert (self.supervisor.running, self.supervisor.pid) == (False, None)


@pytest.fixture
def without_processes(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Make the next `count` starts of a process fail, as the kernel does at its limit of processes."""

    def fail(count: int) -> None:
        start = StandbyWorker.__init__
        left = [count]

        def limited(standby: StandbyWorker, role: Role, log: Path) -> None:
            if left[0]:
                left[0] -= 1
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            start(standby, role, log)

        monkeypatch.setattr(StandbyWorker, "__init__", limited)

    return fail


def test_a_killed_worker_runs_again_with_its_last_command(tmp_path: Path) -> None:
    owner = Owner(tmp_path / "log")
    owner.kill()
    assert owner.supervisor.restart()
    assert owner.exits.get(timeout=EXIT_S) == f"the preview worker failed unexpectedly; see {tmp_path / 'log'}"
    assert "no-such-ring" in (tmp_path / "log").read_text()


def test_a_worker_that_cannot_be_started_again_is_started_after_the_next_delay(
    tmp_path: Path, without_processes: Callable[[int], None]
) -> None:
    owner = Owner(tmp_path / "log")
    owner.kill()
    without_processes(2)
    assert owner.supervisor.restart()
    assert owner.exits.get(timeout=EXIT_S) == f"the preview worker failed unexpectedly; see {tmp_path / 'log'}"


def test_the_owner_is_called_when_a_worker_cannot_be_started_again_at_all(
    tmp_path: Path, without_processes: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spiked_service.workers.supervisor.Backoff", lambda: Backoff((0.0, 0.0)))
    owner = Owner(tmp_path / "log")
    owner.kill()
    without_processes(100)
    assert owner.supervisor.restart()
    told = "the preview worker cannot be started again: Resource temporarily unavailable"
    assert owner.exits.get(timeout=EXIT_S) == told
    assert not owner.supervisor.restart()


def test_a_cancelled_worker_is_not_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spiked_service.workers.supervisor.Backoff", lambda: Backoff((3600.0,)))
    owner = Owner(tmp_path / "log", keep_standby=True)
    owner.kill()
    assert owner.supervisor.restart()
    assert owner.supervisor.cancel(), "a restart was pending"
    assert not owner.supervisor.cancel(), "it is not any more"
    assert not owner.supervisor.restart()
    owner.supervisor.start(NO_RING)
    assert not owner.supervisor.running
    until(lambda: children() == [], "the standby worker has exited")


def test_the_standby_worker_becomes_the_successor(tmp_path: Path) -> None:
    command = AcquisitionCommand(
        source=SMALL, ring_id="test-successor", frames=None, seconds=None, consumers=1, history_s=0
    )
    exits: queue.Queue[str | None] = queue.Queue()
    supervisor = WorkerSupervisor(Role.ACQUISITION, tmp_path / "log", lambda event: None, exits.put, keep_standby=True)
    supervisor.start(command)
    pid = supervisor.pid
    assert pid is not None
    (standby,) = {child.pid for child in children()} - {pid}
    os.kill(pid, signal.SIGKILL)
    assert exits.get(timeout=EXIT_S) == "the acquisition worker was killed by signal 9"
    supervisor.restart()
    until(lambda: supervisor.pid == standby, "the standby worker runs")
    supervisor.dismiss()
    supervisor.join(EXIT_S)
    until(lambda: children() == [], "all have exited")
    clean_stale()
