"""A worker process: its exit is reported whatever happens."""

import threading
from pathlib import Path

from spiked_service.workers.messages import AcquisitionCommand, Role, WorkerEvent
from spiked_service.workers.process import StandbyWorker, WorkerProcess

from spiked.ring import clean_stale


def test_a_listener_that_fails_does_not_hide_the_end_of_the_worker(tmp_path: Path) -> None:
    ended = threading.Event()
    troubles: list[str | None] = []

    def handle(event: WorkerEvent) -> None:
        raise RuntimeError("no more room")

    def end(trouble: str | None) -> None:
        troubles.append(trouble)
        ended.set()

    command = AcquisitionCommand(
        source="sim:?width=96&height=64", ring_id="test-child", frames=8, seconds=None, consumers=1, history_s=0
    )
    WorkerProcess(command, tmp_path / "log", handle, end)
    assert ended.wait(120)
    assert troubles[0] == "an event of the acquisition worker could not be processed: see the log of the service"
    clean_stale()  # as a stream does: a worker that leaves at once may leave its ring
    assert not Path("/dev/shm/spiked-test-child").exists()


def test_bytes_that_a_dead_worker_did_not_read_do_not_hide_its_exit(tmp_path: Path) -> None:
    ended = threading.Event()
    command = AcquisitionCommand(
        source="sim:?width=96&height=64", ring_id="test-dead", frames=None, seconds=None, consumers=1, history_s=0
    )
    standby = StandbyWorker(Role.ACQUISITION, tmp_path / "log")
    WorkerProcess(command, tmp_path / "log", lambda event: None, lambda trouble: ended.set(), standby)
    # A write to a broken pipe leaves bytes behind that closing tries to send once more.
    assert standby.process.stdin is not None
    standby.process.stdin.write(b"late\n")
    standby.process.kill()
    assert ended.wait(120)
    clean_stale()
