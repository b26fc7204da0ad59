"""A store that stalls, refuses and truncates: nothing waits for ever, and nothing is taken in part."""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
from faulty_proxy import ALL, Fault, FaultyProxy
from spiked_service.base.ids import new_id
from spiked_service.cluster import agent_reports, object_store, sweeper
from spiked_service.cluster.agent_reports import ServiceClient, UnansweredError
from spiked_service.cluster.object_store import ObjectStore, ObjectStoreError, stored_file
from spiked_service.cluster.remote_worker import RemoteWorker, Terms
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.cluster.sweeper import Sweeper
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.workers.messages import NotBegun, ReconstructionCommand, WorkerEvent
from waiting import until

from .lab import LEASE_S, SHORT, Lab

PART_BYTES = 5 << 20
TRIES = 3


@pytest.fixture
def proxy(bucket: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyProxy]:
    """What is between this test and the server; it lets go of what it stalls only at the end."""
    import s3fs

    server_port = int(os.environ["AWS_ENDPOINT_URL"].rpartition(":")[2])
    with FaultyProxy(server_port, stall_s=3600) as between:
        monkeypatch.setenv("AWS_ENDPOINT_URL", between.url)
        monkeypatch.setattr(object_store, "_READ_S", 0.5)
        monkeypatch.setattr(object_store, "_QUIET_S", 1.5)
        monkeypatch.setattr(object_store, "_DELAYS_S", (0.0,) * (TRIES - 1))
        monkeypatch.setattr(object_store, "_PART_BYTES", PART_BYTES)
        s3fs.S3FileSystem.clear_instance_cache()
        yield between
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def store(bucket: str, proxy: FaultyProxy) -> ObjectStore:
    """A folder of the bucket, by way of the proxy."""
    return ObjectStore(bucket).below(new_id())


@pytest.fixture
def large(tmp_path: Path) -> Path:
    """A file of several parts."""
    path = tmp_path / "large"
    path.write_bytes(os.urandom(2 * PART_BYTES + 12_345))
    return path


@pytest.mark.parametrize("fault", ALL)
def test_files_arrive_whole_or_not_at_all(
    fault: Fault, store: ObjectStore, proxy: FaultyProxy, large: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_store, "_DELAYS_S", (0.0,) * 30)
    stored = stored_file(large, "large")
    proxy.faults, proxy.share = (fault,), 0.25
    until(lambda: _there_and_back(store, large) == stored and proxy.happened[fault] > 1, "there were faults")
    assert not list(large.parent.glob("*.part"))


def _there_and_back(store: ObjectStore, path: Path) -> object:
    stored, back = stored_file(path, "large"), path.with_name("back")
    store.put_file(path, stored.sha256, stored)
    store.fetch(stored.sha256, back, stored)
    store.put("manifest", b"the end")
    assert store.get("manifest") == b"the end"
    return stored_file(back, "large")


@pytest.mark.parametrize("fault", [Fault.STALL_SENT, Fault.STALL_ANSWER])
def test_a_store_that_stalls_is_given_up_after_a_known_number_of_requests(
    fault: Fault, store: ObjectStore, proxy: FaultyProxy
) -> None:
    proxy.faults, proxy.share = (fault,), 1.0
    with pytest.raises(ObjectStoreError, match=rf"manifest cannot be read, after {TRIES} tries: .*check the store s3:"):
        store.get("manifest")
    assert proxy.requests <= 4 * TRIES


def test_a_store_that_stops_reading_is_given_up(store: ObjectStore, proxy: FaultyProxy, large: Path) -> None:
    """Nothing else limits the time to send what fits into no buffer."""
    proxy.faults, proxy.share, proxy.path = (Fault.STALL_SENT,), 1.0, "partNumber="
    stored = stored_file(large, "large")
    with pytest.raises(ObjectStoreError, match="nothing was moved"):
        store.put_file(large, "a", stored)
    proxy.share = 0.0
    assert not store.has("a", stored)


def test_of_a_recording_only_what_was_truncated_is_read_again(
    store: ObjectStore, proxy: FaultyProxy, large: Path
) -> None:
    stored, back = stored_file(large, "large"), large.with_name("back")
    store.put_file(large, "a", stored)
    before, proxy.faults, proxy.path, proxy.share = proxy.requests, (Fault.TRUNCATE_ANSWER,), "GET", 0.5
    store.fetch("a", back, stored)
    assert stored_file(back, "large") == stored
    assert proxy.happened[Fault.TRUNCATE_ANSWER] > 0
    assert proxy.requests - before == 3 + proxy.happened[Fault.TRUNCATE_ANSWER]


def test_an_empty_object_is_read_as_any(store: ObjectStore, proxy: FaultyProxy) -> None:
    store.put("empty", b"")
    assert store.get("empty") == b"" and store.get("none") is None


def test_an_operation_that_is_wanted_no_more_ends(store: ObjectStore, proxy: FaultyProxy) -> None:
    class WantedNoMore(Exception):
        pass

    over = threading.Event()

    def check() -> None:
        if over.is_set():
            raise WantedNoMore

    proxy.faults, proxy.share = (Fault.STALL_ANSWER,), 1.0
    threading.Thread(target=lambda: until(lambda: proxy.requests, "it has asked") and over.set()).start()
    with pytest.raises(WantedNoMore):
        store.until(check).get("manifest")


def command(folder: Path) -> ReconstructionCommand:
    folder.mkdir()
    (folder / "map.json").write_text("an input")
    return ReconstructionCommand(
        ring=None,
        recording=folder / "recording.dat",
        folder=folder,
        can_block=True,
        options=ReconstructionOptions(),
        intrinsics=None,
    )


@pytest.fixture
def patient(proxy: FaultyProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is when it is not tested: the store has minutes."""
    monkeypatch.setattr(object_store, "_READ_S", 3600)
    monkeypatch.setattr(object_store, "_QUIET_S", 3600.0)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("end", [RemoteWorker.detach, RemoteWorker.dismiss, RemoteWorker.cancel])
def test_nobody_waits_for_a_store_that_stalls(
    end: Callable[[RemoteWorker], None], store: ObjectStore, proxy: FaultyProxy, tmp_path: Path
) -> None:
    """Neither the end of the service, nor a job that is cancelled."""
    events: list[WorkerEvent] = []
    exits: SimpleQueue[str | None] = SimpleQueue()
    proxy.faults, proxy.share = (Fault.STALL_SENT,), 1.0
    worker = RemoteWorker(
        "one",
        command(tmp_path / "job"),
        store,
        SharedRecordings(store),
        Terms(lease_s=30.0, grace_s=0.5),
        lambda: pytest.fail("its files are not stored"),
        False,
        lambda after_s: None,
        events.append,
        exits.put,
    )
    until(lambda: proxy.requests, "it stores its files")
    end(worker)
    worker.kill_after(20.0)
    if end is not RemoteWorker.detach:
        assert "before the attempt was over" in f"{exits.get(timeout=20)}"
        assert events == [NotBegun()]
    else:
        assert exits.empty() and events == []


def test_a_service_whose_store_stalls_answers_cancels_and_ends(
    daemon: Callable[..., Any], moving: Path, scratch: Path, bucket: str, proxy: FaultyProxy
) -> None:
    pytest.importorskip("submitit")
    lab = Lab(daemon, moving, scratch, LEASE_S, f"{bucket}/{new_id()}")
    proxy.faults, proxy.share = (Fault.STALL_ANSWER,), 1.0
    job = lab.submit(SHORT)
    until(proxy.happened.total, "its files are stored")
    lab.post(f"reconstructions/{job}:cancel")
    lab.reached(job, lambda row: row["state"] == "cancelled", "it is cancelled")
    before = proxy.happened.total()
    lab.submit(SHORT)
    until(lambda: proxy.happened.total() > before, "the files of another one are stored")
    lab.one.close()
    assert lab.one.process.returncode == 0


def test_a_sweep_that_failed_is_repeated_soon(
    store: ObjectStore, proxy: FaultyProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweeper, "_AGAIN_S", 0.1)
    store.below(new_id(), new_id()).put("a", b"left by an earlier service")
    proxy.faults, proxy.share = (Fault.BUSY,), 1.0
    one = Sweeper(store, lambda attempt: False, SharedRecordings(store.below("recordings")))
    one.start()
    until(lambda: proxy.happened[Fault.BUSY] >= 2 * TRIES, "it has failed")
    proxy.share = 0.0
    until(lambda: not store.folders(), "it has swept")
    one.close()


def test_an_agent_that_is_cut_off_does_not_wait_longer_than_its_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent_reports, "_ANSWER_S", 3600.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # the kernel takes connections, and nobody answers
        service = ServiceClient(f"http://127.0.0.1:{silent.getsockname()[1]}", "one", "token")
        with pytest.raises(UnansweredError):
            service.post(":report", "{}", time.monotonic() + 0.5)
        service.close()
