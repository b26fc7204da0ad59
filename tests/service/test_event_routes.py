"""Events over real sockets: WebSocket and server-sent events, with clients that are slow, rude or gone."""

import base64
import json
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import httpx
import pytest
import uvicorn
from fastapi import FastAPI
from pydantic import BaseModel
from spiked_service.api.problems import install
from spiked_service.api.routes import events
from spiked_service.api.routes.events import event_routes
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.events.bus import Bus, Topic
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

DEADLINE_S = 20.0
CLIENTS = 4


class Note(BaseModel):
    number: int
    filling: str = ""


class Service:
    """The event routes alone, on a real server in a thread."""

    def __init__(self) -> None:
        self.bus = Bus()
        self.concurrency = ConcurrencyLimit("event clients", CLIENTS)
        app = FastAPI()
        install(app)
        app.include_router(event_routes(self.bus, self.concurrency), prefix="/api/v1")
        config = uvicorn.Config(app, log_level="warning", ws_per_message_deflate=False, timeout_graceful_shutdown=1)
        self.server = uvicorn.Server(config)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}/api/v1/events"
        self.thread = threading.Thread(target=self.server.run, kwargs={"sockets": [self.listener]})
        self.thread.start()

    def close(self) -> None:
        self.server.should_exit = True
        self.thread.join()

    def client(self, query: str = "") -> Any:
        before = self.bus.subscribers()
        client = connect(f"ws://{self.address}?{query}", compression=None, legacy=True)
        wait_for(lambda: self.bus.subscribers() > before)
        return client


@pytest.fixture
def service() -> Iterator[Service]:
    one = Service()
    yield one
    one.close()


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


def receive(client: Any, count: int) -> list[dict[str, Any]]:
    return [json.loads(client.recv(timeout=DEADLINE_S)) for _ in range(count)]


def test_a_client_gets_its_topics_in_order(service: Service) -> None:
    with service.client("topics=pose,scene") as client:
        for number in range(20):
            service.bus.publish(Topic.POSE if number % 2 else Topic.LOG, Note(number=number), capture_id="c")
        got = receive(client, 10)
    assert [message["data"]["number"] for message in got] == list(range(1, 20, 2))
    assert {message["topic"] for message in got} == {"pose"}
    wait_for(lambda: service.bus.subscribers() == 0 and service.concurrency.active == 0)


def test_a_client_that_comes_back_goes_on_where_it_was(service: Service) -> None:
    for number in range(5):
        service.bus.publish(Topic.JOB, Note(number=number))
    with service.client("since=3") as client:
        assert [message["seq"] for message in receive(client, 2)] == [4, 5]


def test_a_silent_websocket_gets_empty_messages_if_it_asks_for_them(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "_HEARTBEAT_S", 0.05)
    with service.client("topics=pose&heartbeat=1") as beating, service.client("topics=pose") as silent:
        assert [beating.recv(timeout=DEADLINE_S) for _ in range(3)] == ["", "", ""]
        service.bus.publish(Topic.POSE, Note(number=7))
        assert next(text for text in iter(lambda: beating.recv(timeout=DEADLINE_S), None) if text).startswith("{")
        assert receive(silent, 1)[0]["data"]["number"] == 7


@pytest.mark.parametrize(
    "query", ["heartbeat=yes", "topics=poses", "since=-1", "since=1e3", "since=" + "9" * 40, "topics=lost"]
)
def test_a_wrong_question_is_refused_with_a_problem(service: Service, query: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://{service.address}?{query}")
    assert refused.value.response.status_code == 422
    assert json.loads(refused.value.response.body)["detail"]
    answer = httpx.get(f"http://{service.address}?{query}")
    assert (answer.status_code, answer.headers["content-type"]) == (422, "application/problem+json")


def test_only_so_many_clients(service: Service) -> None:
    clients = [service.client() for _ in range(CLIENTS)]
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://{service.address}")
    assert refused.value.response.status_code == 503
    assert httpx.get(f"http://{service.address}").status_code == 503
    for client in clients:
        client.close()
    wait_for(lambda: service.concurrency.active == 0)
    service.client().close()


def test_a_client_that_talks_is_shown_out(service: Service) -> None:
    with service.client() as client:
        client.send("hello")
        with pytest.raises(ConnectionClosed) as closed:
            client.recv(timeout=DEADLINE_S)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1003
    wait_for(lambda: service.concurrency.active == 0)


def raw_client(service: Service) -> socket.socket:
    """A WebSocket client by hand with a small window, which reads only when told to."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    host, _, rest = service.address.partition(":")
    port, _, path = rest.partition("/")
    connection.connect((host, int(port)))
    connection.settimeout(DEADLINE_S)
    key = base64.b64encode(os.urandom(16)).decode()
    connection.sendall(
        f"GET /{path} HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += connection.recv(1)
    assert answer.startswith(b"HTTP/1.1 101")
    return connection


def frames(connection: socket.socket) -> Iterator[dict[str, Any]]:
    """The messages of unfragmented, unmasked text frames (RFC 6455, 5.2)."""
    with connection.makefile("rb") as stream:
        while head := stream.read(2):
            if len(head) < 2 or head[0] != 0x81:
                return
            length = head[1]
            if length == 126:
                length = int.from_bytes(stream.read(2), "big")
            elif length == 127:
                length = int.from_bytes(stream.read(8), "big")
            yield json.loads(stream.read(length))


def test_a_client_that_reads_nothing_stops_nobody_and_learns_what_it_lost(service: Service) -> None:
    with closing(raw_client(service)) as slow, service.client("topics=pose") as quick:
        wait_for(lambda: service.bus.subscribers() == 2)
        rounds, burst = 60, 100
        for first in range(0, rounds * burst, burst):
            for number in range(first, first + burst):
                service.bus.publish(Topic.POSE, Note(number=number, filling="x" * 1000))
            service.bus.publish(Topic.PREVIEW, Note(number=first, filling="x" * 20_000))
            got = receive(quick, burst)  # the quick one keeps up all the time
            assert [message["data"]["number"] for message in got] == list(range(first, first + burst))
        assert sum(service.bus.dropped().values()) > 0

        last, seen, lost = 0, {"pose": 0, "preview": 0}, {"pose": 0, "preview": 0}
        for message in frames(slow):
            if message["topic"] == "lost":
                assert message["data"]["why"] == "slow"
                for topic, count in message["data"]["by_topic"].items():
                    lost[topic] += count
            else:
                assert message["seq"] > last
                last = message["seq"]
                seen[message["topic"]] += 1
            if seen["pose"] + lost["pose"] == rounds * burst and seen["preview"] + lost["preview"] == rounds:
                break
        assert lost["preview"] / rounds > lost["pose"] / (rounds * burst) > 0
    wait_for(lambda: service.concurrency.active == 0)


def test_a_client_that_is_stuck_is_left(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spiked_service.api.streams.STUCK_S", 0.3)
    with closing(raw_client(service)):
        wait_for(lambda: service.bus.subscribers() == 1)
        for number in range(4000):
            service.bus.publish(Topic.POSE, Note(number=number, filling="x" * 4000))
        wait_for(lambda: service.bus.subscribers() == 0 and service.concurrency.active == 0)


def test_clients_that_vanish_with_messages_on_their_way_cause_no_noise(
    service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(3):
        gone = raw_client(service)
        wait_for(lambda: service.bus.subscribers() == 1)
        gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, not a farewell
        gone.close()
        for number in range(300):
            service.bus.publish(Topic.POSE, Note(number=number))
        wait_for(lambda: service.bus.subscribers() == 0 and service.concurrency.active == 0)
    assert not [record for record in caplog.records if record.name == "asyncio"]


@pytest.mark.parametrize(
    "junk",
    [
        b"\x81\x05hello",  # not masked
        b"\xf1\x80\x00\x00\x00\x00",  # reserved bits
        b"\x83\x80\x00\x00\x00\x00",  # an opcode that does not exist
        b"\x81\xff\x7f" + b"\xff" * 7,  # 2^63 bytes announced
        b"\x80\x80\x00\x00\x00\x00",  # continues nothing
        b"\x81\x82\x00\x00\x00\x00\xc3\x28",  # not UTF-8
        os.urandom(500),
    ],
)
def test_malformed_frames_end_only_their_own_connection(service: Service, junk: bytes) -> None:
    with service.client() as other:
        with closing(raw_client(service)) as rude:
            wait_for(lambda: service.bus.subscribers() == 2)
            rude.sendall(junk)
            rude.shutdown(socket.SHUT_WR)
            wait_for(lambda: service.bus.subscribers() == 1)
        service.bus.publish(Topic.LOG, Note(number=1))
        assert receive(other, 1)[0]["data"]["number"] == 1


def test_server_sent_events_resume_by_the_browsers_own_header(service: Service) -> None:
    for number in range(3):
        service.bus.publish(Topic.JOB, Note(number=number))
    with httpx.stream("GET", f"http://{service.address}", headers={"Last-Event-ID": "1"}) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = answer.iter_lines()
        got = [next(lines) for _ in range(9)]
    assert got[0].startswith(":")
    assert got[2:4] == ["id: 2", "event: job"]
    assert json.loads(got[4].removeprefix("data: "))["data"]["number"] == 1
    assert got[6] == "id: 3"
    wait_for(lambda: service.bus.subscribers() == 0 and service.concurrency.active == 0)
