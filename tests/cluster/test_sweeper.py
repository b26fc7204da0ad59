"""What attempts that are over leave in the store is removed, and nothing else."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from spiked_service.base.ids import new_id
from spiked_service.cluster.job_files import OUTPUTS
from spiked_service.cluster.object_store import ObjectStore
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.cluster.sweeper import Sweeper
from waiting import meanwhile, until


@pytest.fixture(params=["folder", "bucket"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> ObjectStore:
    """The store of a service: below a folder, or below a bucket of a real server."""
    uri = tmp_path.as_uri() if request.param == "folder" else request.getfixturevalue("bucket")
    return ObjectStore(uri).below(new_id())


def sweeper_of(store: ObjectStore, alive: Callable[[str], bool]) -> Sweeper:
    return Sweeper(store, alive, SharedRecordings(store.below("recordings")))


def test_only_what_is_over_is_swept(store: ObjectStore) -> None:
    job, alive, over, other_job, other = (new_id() for _ in range(5))
    for attempt in ((job, alive), (job, over), (other_job, other), ("of-somebody-else", "x")):
        store.below(*attempt).put(f"{OUTPUTS}/1", b"content")
    assert sweeper_of(store, lambda attempt: attempt == alive).sweep() == 2
    assert store.below(job, alive).get(f"{OUTPUTS}/1") == b"content"
    assert store.below("of-somebody-else", "x").get(f"{OUTPUTS}/1") == b"content"
    assert store.below(job).folders() == [alive]
    assert sorted(store.folders()) == sorted([job, "of-somebody-else"])


def test_an_attempt_that_begins_and_stores_during_sweeps_loses_nothing(store: ObjectStore) -> None:
    job, alive, lock = new_id(), set[str](), threading.Lock()

    def is_alive(attempt: str) -> bool:
        with lock:
            return attempt in alive

    sweeper = sweeper_of(store, is_alive)

    with meanwhile(sweeper.sweep):
        for _ in range(20):
            attempt = new_id()
            with lock:
                alive.add(attempt)  # as the service does, before anything is stored
            mine = store.below(job, attempt)
            for number in range(5):
                mine.put(f"{OUTPUTS}/{number}", b"content")
            assert all(mine.get(f"{OUTPUTS}/{number}") == b"content" for number in range(5))
            with lock:
                alive.discard(attempt)
    sweeper.sweep()
    assert store.folders() == []


def test_uploads_that_nobody_goes_on_with_are_ended(bucket: str) -> None:
    """Of agents and services that were killed while they stored something large: no listing of objects shows them."""
    import s3fs

    files, store = s3fs.S3FileSystem(), ObjectStore(bucket).below(new_id())
    job, alive, over, name = (new_id() for _ in range(4))
    root = store.uri.partition("://")[2].partition("/")[2]
    wanted = {f"{root}/{job}/{alive}/outputs/1", f"{root}-of-somebody-else/x"}
    left = {f"{root}/{job}/{over}/outputs/1", f"{root}/recordings/{name}"}
    for key in wanted | left:
        files.call_s3("create_multipart_upload", Bucket="spiked-test", Key=key)
    sweeper_of(store, lambda attempt: attempt == alive).sweep()
    assert {one["Key"] for one in files.list_multipart_uploads("spiked-test")} >= wanted
    assert not {one["Key"] for one in files.list_multipart_uploads("spiked-test")} & left


def test_a_sweeper_sweeps_at_its_start_and_whenever_it_is_woken(tmp_path: Path) -> None:
    store = ObjectStore(tmp_path.as_uri())
    store.below(new_id(), new_id()).put("a", b"left by an earlier service")
    sweeper = sweeper_of(store, lambda attempt: False)
    assert store.folders()
    sweeper.start()
    until(lambda: not store.folders(), "it has swept at the start")
    store.below(new_id(), new_id()).put("a", b"left since")
    sweeper.wake()
    until(lambda: not store.folders(), "it has swept again")
    sweeper.close()
