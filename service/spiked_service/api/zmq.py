"""Events over ZeroMQ for programs on this machine: PUB for events, REP for the current state.

PUB drops, without a word, what a subscriber has no room for. So pictures have a socket of their own with room for two:
they go first, and cannot displace anything else. Every message says its number within its topic, `topic_seq`, so that a
subscriber sees what it has lost; REP gives it again as long as it is remembered. REP is played by a ROUTER: a socket of
that kind waits for each asker who takes no answer, and all others with it.
"""

import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import msgpack
import zmq

from spiked.errors import ConfigurationError
from spiked_service.base.health import CheckStatus
from spiked_service.events.bus import PUBLISHED, Bus, Message, Topic, pack

_LOOPBACK = "127.0.0.1"
QUEUE_MESSAGES = 10_000
"""High-water mark, messages."""
QUEUE_PICTURES = 2
"""High-water mark of the sockets of pictures and of state, messages."""
REQUEST_BYTES = 65_536
"""Largest request; the sender of a larger one is disconnected."""
_ANSWER_MESSAGES = 4096
"""Most past messages in an answer."""
_LOOK_MS = 200
"""Interval at which the threads check that the service ends, ms."""


@dataclass(frozen=True)
class Endpoints:
    """Addresses of the sockets."""

    events: str
    state: str
    previews: str


class ZmqServer:
    """Two threads: one publishes, one replies. Bound to loopback only, because these sockets check no tokens."""

    def __init__(self, bus: Bus, first_port: int = 0) -> None:
        """Bind `first_port` and the two after it, free ports for 0. Raises ConfigurationError if one is in use."""
        self._bus = bus
        self._context = zmq.Context()
        try:
            self._events, self._state, self._previews = (
                self._bound(kind, queue, first_port and first_port + offset)
                for offset, (kind, queue) in enumerate(
                    [(zmq.PUB, QUEUE_MESSAGES), (zmq.ROUTER, QUEUE_PICTURES), (zmq.PUB, QUEUE_PICTURES)]
                )
            )
        except ConfigurationError:
            self._context.destroy(linger=0)
            raise
        sockets = (self._events, self._state, self._previews)
        self.endpoints = Endpoints(*(socket.getsockopt_string(zmq.LAST_ENDPOINT) for socket in sockets))
        self._subscription = bus.subscribe(capacity=QUEUE_MESSAGES, previews_capacity=QUEUE_PICTURES)
        self._over = threading.Event()
        self._threads = [
            threading.Thread(target=self._publish, name="zmq events"),
            threading.Thread(target=self._answer, name="zmq state"),
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop both threads and unbind."""
        self._over.set()
        self._subscription.close()
        for thread in self._threads:
            thread.join()
        self._context.destroy(linger=0)

    def check(self) -> tuple[CheckStatus, str]:
        """Whether both threads are running."""
        dead = [thread.name for thread in self._threads if not thread.is_alive()]
        if dead and not self._over.is_set():
            return CheckStatus.FAILED, f"{' and '.join(dead)} stopped working; the log says why: restart the service"
        return CheckStatus.OK, f"events at {self.endpoints.events}"

    def _bound(self, kind: int, queue: int, port: int) -> "zmq.Socket[bytes]":
        socket = self._context.socket(kind)
        socket.set(zmq.LINGER, 0)
        socket.set(zmq.SNDHWM, queue)
        socket.set(zmq.MAXMSGSIZE, REQUEST_BYTES)
        socket.set(zmq.HEARTBEAT_IVL, 10_000)
        socket.set(zmq.SNDTIMEO, 1000)
        address = f"tcp://{_LOOPBACK}:{port or '*'}"
        try:
            socket.bind(address)
        except zmq.ZMQError as error:
            raise ConfigurationError(
                f"cannot listen at {address} for ZeroMQ: {error.strerror}; choose the first of three free ports with "
                "--set zmq_port=N (SPIKED_ZMQ_PORT, zmq_port in spiked.toml), or give --no-zmq"
            ) from error
        return socket

    def _publish(self) -> None:
        while not self._over.is_set():
            message = self._subscription.take(timeout_s=1.0)
            if message is None or message.topic is Topic.LOST:
                continue  # subscribers see the loss from topic_seq
            socket = self._previews if message.topic is Topic.PREVIEW else self._events
            socket.send_multipart([message.topic.encode(), message.packed])

    def _answer(self) -> None:
        while not self._over.is_set():
            if not self._state.poll(_LOOK_MS):
                continue
            frames = self._state.recv_multipart()
            if b"" not in frames:
                continue  # not a request of a REQ socket, so nobody waits for a reply
            question = frames.index(b"") + 1
            answer = pack(_answer(self._bus, frames[question:]))
            with suppress(zmq.Again):  # the requester does not receive
                self._state.send_multipart([*frames[:question], answer], zmq.NOBLOCK)


def _answer(bus: Bus, frames: list[bytes]) -> dict[str, Any]:
    """Reply to a request, or its error."""
    try:
        if len(frames) != 1:
            raise ValueError(f"{len(frames)} frames")
        question = msgpack.unpackb(frames[0])
    except (ValueError, msgpack.UnpackException) as error:
        return _wrong(f"not one frame of msgpack: {error}")
    match question:
        case {"get": "state"}:
            newest = [message.plain() for messages in bus.state().values() for message in messages]
            return {"seq": bus.seq, "messages": sorted(newest, key=lambda message: int(message["seq"]))}
        case {"get": "messages", "since": int(since)} if since >= 0:
            return {"seq": bus.seq, "messages": [message.plain() for message in _since(bus, since)]}
    return _wrong("the question is none of those known")


def _since(bus: Bus, since: int) -> list[Message]:
    subscription = bus.subscribe(PUBLISHED, _ANSWER_MESSAGES, since=since)
    messages = []
    while (message := subscription.take()) is not None:
        messages.append(message)
    subscription.close()
    return messages


def _wrong(detail: str) -> dict[str, Any]:
    return {
        "error": {
            "title": "Bad Request",
            "status": 400,
            "detail": f"{detail[:200]}; ask {{'get': 'state'}} or {{'get': 'messages', 'since': SEQ}} in msgpack",
        }
    }
