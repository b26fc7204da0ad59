"""The service's end of a worker: its end is told whatever happens."""

import threading
from pathlib import Path

from spiked_service.child import Child
from spiked_service.messages import AcquisitionOrder, News

from spiked.ring import clean_stale


def test_a_listener_that_fails_does_not_hide_the_end_of_the_worker(tmp_path: Path) -> None:
    ended = threading.Event()
    troubles: list[str | None] = []

    def hear(news: News) -> None:
        raise RuntimeError("no more room")

    def end(trouble: str | None) -> None:
        troubles.append(trouble)
        ended.set()

    order = AcquisitionOrder(
        source="sim:?width=96&height=64", ring_id="test-child", frames=8, seconds=None, consumers=1, history_s=0
    )
    Child(order, tmp_path / "log", hear, end)
    assert ended.wait(120)
    assert troubles[0] is not None and "no more room" in troubles[0]
    clean_stale()  # as a stream does: a worker that leaves at once may leave its ring
    assert not Path("/dev/shm/spiked-test-child").exists()


def test_words_that_a_dead_worker_never_took_do_not_hide_its_end(tmp_path: Path) -> None:
    ended = threading.Event()
    order = AcquisitionOrder(
        source="sim:?width=96&height=64", ring_id="test-dead", frames=None, seconds=None, consumers=1, history_s=0
    )
    child = Child(order, tmp_path / "log", lambda news: None, lambda trouble: ended.set())
    # What a write leaves behind that met a broken pipe: bytes that closing tries to send once more.
    child._stdin.write(b"late words\n")
    child._process.kill()
    assert ended.wait(120)
    clean_stale()
