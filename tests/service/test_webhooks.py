"""Webhooks: an address is told once when a job has ended."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from queue import Empty, Queue
from typing import Any

import pytest
from pydantic import BaseModel
from spiked_service.events.bus import Bus, Topic
from spiked_service.operations.webhooks import Webhooks
from spiked_service.settings.settings import load_settings

from spiked.errors import ConfigurationError


class Job(BaseModel):
    """The fields of a job that matter here."""

    state: str
    ended_at: str | None = None


@contextmanager
def listening(answers: list[int]) -> Iterator[tuple[str, "Queue[dict[str, Any]]"]]:
    """An HTTP server that answers with these codes, then 204, and what it was sent."""
    sent: Queue[dict[str, Any]] = Queue()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["content-length"])))
            sent.put({**body, "event": self.headers["x-spiked-event"]})
            self.send_response(answers.pop(0) if answers else 204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Nothing."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/done", sent
    finally:
        server.shutdown()
        server.server_close()


def test_an_end_is_told_once_and_again_after_an_error() -> None:
    bus = Bus()
    with listening([500]) as (address, sent):
        hooks = Webhooks(bus, lambda: [address], delays_s=(0.01,))
        bus.publish(Topic.JOB, Job(state="running"), "c1", "j1")
        bus.publish(Topic.JOB, Job(state="complete", ended_at="t"), "c1", "j1")
        bus.publish(Topic.JOB, Job(state="complete", ended_at="t"), "c1", "j1")  # it was cleaned, for example
        bus.publish(Topic.JOB, Job(state="failed", ended_at="u"), "c2", "j2")
        told = [sent.get(timeout=10) for _ in range(3)]
        with pytest.raises(Empty):
            sent.get(timeout=0.3)
        hooks.close()
    assert [one["reconstruction_id"] for one in told] == ["j1", "j1", "j2"]  # j1 twice: the first answer was 500
    assert told[0]["data"]["state"] == "complete" and told[0]["event"] == "job" and told[0]["topic"] == "job"


def test_an_address_that_is_not_there_delays_nothing_else() -> None:
    bus = Bus()
    with listening([]) as (address, sent):
        hooks = Webhooks(bus, lambda: ["http://host:abc/x", "http://127.0.0.1:9/", address], delays_s=(0.01,))
        bus.publish(Topic.JOB, Job(state="cancelled", ended_at="t"), "c1", "j1")
        assert sent.get(timeout=10)["data"]["state"] == "cancelled"
        hooks.close()


def test_only_addresses_of_web_servers_are_taken() -> None:
    assert load_settings({"webhooks": "https://example.org/x"}).settings.webhooks == ["https://example.org/x"]
    for wrong in ("ftp://example.org", "http://example.org:abc/x", "http://example.org:70000"):
        with pytest.raises(ConfigurationError, match="is no address"):
            load_settings({"webhooks": wrong})
