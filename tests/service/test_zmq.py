"""Events over ZeroMQ: the same messages, a slow subscriber, wrong questions."""

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import msgpack
import pytest
import zmq
from pydantic import BaseModel
from spiked_service.api.zmq import ZmqServer
from spiked_service.events.bus import Bus, Topic

from spiked.errors import ConfigurationError

DEADLINE_MS = 10_000


class Note(BaseModel):
    number: int
    filling: str = ""


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def server(bus: Bus) -> Iterator[ZmqServer]:
    one = ZmqServer(bus)
    yield one
    one.close()


@pytest.fixture
def context() -> Iterator["zmq.Context[Any]"]:
    one: zmq.Context[Any] = zmq.Context()
    yield one
    one.destroy(linger=0)


def subscriber(context: "zmq.Context[Any]", bus: Bus, *addresses: str, **options: int) -> Any:
    """A subscriber that is known to be connected to all addresses."""
    socket = context.socket(zmq.SUB)
    for name, value in options.items():
        socket.set(getattr(zmq, name), value)
    socket.set(zmq.RCVTIMEO, 20)
    for address in addresses:
        socket.connect(address)
    socket.subscribe(b"")
    missing = {Topic.LOG, Topic.PREVIEW} if len(addresses) == 2 else {Topic.LOG}
    deadline = time.monotonic() + DEADLINE_MS / 1000
    while missing:
        assert time.monotonic() < deadline
        for topic in missing:
            bus.publish(topic, Note(number=-1))
        with suppress(zmq.Again):
            missing.discard(Topic(socket.recv_multipart()[0].decode()))
    with suppress(zmq.Again):
        while True:
            socket.recv_multipart()
    socket.set(zmq.RCVTIMEO, DEADLINE_MS)
    return socket


def ask(context: "zmq.Context[Any]", server: ZmqServer, *frames: bytes) -> dict[str, Any]:
    socket = context.socket(zmq.REQ)
    socket.set(zmq.RCVTIMEO, DEADLINE_MS)
    socket.connect(server.endpoints.state)
    socket.send_multipart(frames)
    answer = dict(msgpack.unpackb(socket.recv()))
    socket.close()
    return answer


def test_a_subscriber_gets_the_same_messages(bus: Bus, server: ZmqServer, context: "zmq.Context[Any]") -> None:
    listener = subscriber(context, bus, server.endpoints.events, server.endpoints.previews)
    first = bus.publish(Topic.POSE, Note(number=1), capture_id="c")
    topic, packed = listener.recv_multipart()
    message = msgpack.unpackb(packed)
    assert topic == b"pose"
    assert (message["seq"], message["topic_seq"], message["capture_id"]) == (first, 1, "c")
    assert message["data"] == {"number": 1, "filling": ""}
    bus.publish(Topic.PREVIEW, Note(number=2))
    assert listener.recv_multipart()[0] == b"preview"


def test_a_slow_subscriber_loses_pictures_first_sees_it_and_stops_nobody(
    bus: Bus, server: ZmqServer, context: "zmq.Context[Any]"
) -> None:
    slow = subscriber(context, bus, server.endpoints.events, server.endpoints.previews, RCVHWM=1, RCVBUF=4096)
    quick = subscriber(context, bus, server.endpoints.events)
    poses, pictures = 4000, 200
    for number in range(poses):
        bus.publish(Topic.POSE, Note(number=number))
        if number % (poses // pictures) == 0:
            bus.publish(Topic.PREVIEW, Note(number=number, filling="x" * 100_000))
        topic, packed = quick.recv_multipart()
        assert (topic, msgpack.unpackb(packed)["data"]["number"]) == (b"pose", number)
    got: dict[str, list[int]] = {"pose": [], "preview": [], "log": []}
    while len(got["pose"]) < poses:
        topic, packed = slow.recv_multipart()
        got[topic.decode()].append(msgpack.unpackb(packed)["topic_seq"])
    assert got["pose"] == list(range(1, poses + 1))
    assert len(got["preview"]) < pictures  # which the numbers show too: some are missing, or the last ones
    assert bus.published()[Topic.PREVIEW] - got["preview"][0] + 1 > len(got["preview"])


def test_the_state_and_what_was_missed_can_be_asked_for(
    bus: Bus, server: ZmqServer, context: "zmq.Context[Any]"
) -> None:
    for number in range(3):
        bus.publish(Topic.JOB, Note(number=number), reconstruction_id="r")
    state = ask(context, server, msgpack.packb({"get": "state"}))
    assert state["seq"] == 3
    assert [message["data"]["number"] for message in state["messages"]] == [2]
    missed = ask(context, server, msgpack.packb({"get": "messages", "since": 1}))
    assert [message["seq"] for message in missed["messages"]] == [2, 3]


@pytest.mark.parametrize(
    "frames",
    [
        [b""],
        [b"\xc1"],
        [b'{"get": "state"}'],
        [os.urandom(1000)],
        [msgpack.packb({"get": "everything"})],
        [msgpack.packb({"get": "messages", "since": "yesterday"})],
        [msgpack.packb({"get": "messages", "since": -1})],
        [msgpack.packb([1, 2])],
        [b"\x91" * 5000],
        [b"\xdd\xff\xff\xff\xff"],
        [msgpack.packb({"get": "state"}), b"more"],
    ],
)
def test_a_wrong_question_is_answered_so(
    bus: Bus, server: ZmqServer, context: "zmq.Context[Any]", frames: list[bytes]
) -> None:
    assert ask(context, server, *frames)["error"]["status"] == 400
    assert "messages" in ask(context, server, msgpack.packb({"get": "state"}))


def test_a_question_that_is_too_long_ends_only_its_own_connection(
    bus: Bus, server: ZmqServer, context: "zmq.Context[Any]"
) -> None:
    rude = context.socket(zmq.REQ)
    rude.connect(server.endpoints.state)
    rude.send(b"x" * 1_000_000)
    assert rude.poll(300) == 0
    assert "messages" in ask(context, server, msgpack.packb({"get": "state"}))


def test_one_who_asks_much_and_leaves_keeps_nobody_waiting(server: ZmqServer, context: "zmq.Context[Any]") -> None:
    for _ in range(3):
        with zmq.Context() as own, own.socket(zmq.DEALER) as rude:
            rude.set(zmq.LINGER, 0)
            rude.connect(server.endpoints.state)
            for _ in range(20):
                rude.send_multipart([b"", b"odd"])
                rude.send_multipart([b"no envelope"])
            time.sleep(0.003)  # some of it is sent, and its answers find nobody
        begun_s = time.monotonic()
        assert "messages" in ask(context, server, msgpack.packb({"get": "state"}))
        assert time.monotonic() - begun_s < 2.0


def test_a_port_that_is_taken_is_an_error_that_says_so(bus: Bus, server: ZmqServer) -> None:
    port = int(server.endpoints.events.rpartition(":")[2])
    with pytest.raises(ConfigurationError, match=f":{port} for ZeroMQ: .*in use"):
        ZmqServer(Bus(), port)
