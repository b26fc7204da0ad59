"""Publishes the events of the service to subscribers, as numbered messages. Publishing never blocks."""

import asyncio
import json
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection, Iterable
from datetime import UTC, datetime
from enum import StrEnum
from functools import cached_property, partial
from typing import Any

import msgpack
from pydantic import BaseModel

from spiked_service.events.payloads import LostPayload, Why

HISTORY = 4096
"""Messages kept for subscribers that reconnect; previews are not kept."""
_STATES = 256
"""Latest states kept per topic; the least recently changed one is dropped first."""


class Topic(StrEnum):
    """The subject of a message."""

    DEVICE = "device"
    CAPTURE = "capture"
    JOB = "job"
    POSE = "pose"
    SCENE = "scene"
    PREVIEW = "preview"
    LOG = "log"
    LOST = "lost"
    """Sent to the subscriber that lost messages, without being subscribed to; never published."""


PUBLISHED = frozenset(Topic) - {Topic.LOST}
_WITH_STATE = frozenset({Topic.DEVICE, Topic.CAPTURE, Topic.JOB, Topic.POSE, Topic.SCENE})


class Message:
    """A message; its payload must not change. Encoded at most once for all subscribers."""

    def __init__(
        self,
        seq: int,
        topic: Topic,
        at: datetime,
        payload: BaseModel,
        capture_id: str | None = None,
        reconstruction_id: str | None = None,
        topic_seq: int = 0,
    ) -> None:
        self.seq = seq
        self.topic_seq = topic_seq
        self.topic = topic
        self.at = at
        self.payload = payload
        self.capture_id = capture_id
        self.reconstruction_id = reconstruction_id

    @cached_property
    def json(self) -> str:
        """The JSON text for WebSocket and server-sent events."""
        head = json.dumps(self._head(), separators=(",", ":"))
        return f'{head[:-1]},"data":{self.payload.model_dump_json()}}}'

    @cached_property
    def packed(self) -> bytes:
        """The msgpack bytes for ZeroMQ: the same fields, images as bytes."""
        return pack(self.plain())

    def plain(self) -> dict[str, Any]:
        """The fields, for `pack`."""
        return {**self._head(), "data": self.payload.model_dump()}

    def _head(self) -> dict[str, Any]:
        return {
            "seq": self.seq,
            "topic": self.topic,
            "topic_seq": self.topic_seq,
            "at": _text(self.at),
            "capture_id": self.capture_id,
            "reconstruction_id": self.reconstruction_id,
        }


def pack(value: object) -> bytes:
    """Encode as msgpack; times become ISO 8601 text, other types without a msgpack form their text."""
    return bytes(msgpack.packb(value, default=lambda odd: _text(odd) if isinstance(odd, datetime) else str(odd)))


def _text(at: datetime) -> str:
    return at.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


class Subscription:
    """A bounded queue of messages for one subscriber. Lost messages are counted and reported by a `lost` message.

    When it is full, the oldest preview is dropped, without previews the oldest message. Only one thread may take.
    """

    def __init__(self, bus: "Bus", topics: Collection[Topic], capacity: int, previews_capacity: int) -> None:
        self._bus = bus
        self._topics = frozenset(topics)
        self._capacity = capacity
        self._previews_capacity = previews_capacity
        self._changed = threading.Condition()
        self._waiting: deque[Message] = deque()
        self._previews: deque[Message] = deque()
        self._lost: Counter[Topic] = Counter()
        self._lost_seqs = (0, 0)
        self._first: deque[LostPayload] = deque()
        self._wake: Callable[[], None] | None = None
        self._last_seq = 0
        self._closed = False
        self.lost: Counter[Topic] = Counter()
        """Messages dropped since the subscription began, by topic."""

    def take(self, timeout_s: float = 0.0) -> Message | None:
        """The next message, None after `timeout_s`. A `lost` message precedes the messages after a loss."""
        with self._changed:
            self._changed.wait_for(self._ready, timeout_s)
            return self._next()

    async def next(self) -> Message | None:
        """The next message; None after `close`."""
        loop = asyncio.get_running_loop()
        while True:
            with self._changed:
                message = self._next()
                if message is not None or self._closed:
                    return message
                arrived = asyncio.Event()
                self._wake = partial(_set_soon, loop, arrived)
            await arrived.wait()

    def close(self) -> None:
        """End the subscription and wake its reader."""
        self._bus._forget(self)
        with self._changed:
            self._closed = True
            self._notify()

    def __len__(self) -> int:
        """Number of waiting messages."""
        return len(self._waiting) + len(self._previews)

    def _begin(self, seq: int, missed: LostPayload | None, kept: Iterable[Message]) -> None:
        self._last_seq = seq
        if missed is not None:
            self._first.append(missed)
        for message in kept:
            self._put(message)

    def _put(self, message: Message) -> None:
        if message.topic not in self._topics:
            return
        with self._changed:
            if self._closed:
                return
            if message.topic is Topic.PREVIEW:
                if len(self._previews) >= self._previews_capacity:
                    self._drop(self._previews.popleft() if self._previews else message)
                    if self._previews_capacity == 0:
                        return
                self._previews.append(message)
            else:
                self._waiting.append(message)
            if len(self) > self._capacity:
                self._drop((self._previews or self._waiting).popleft())
            self._notify()

    def _drop(self, message: Message) -> None:
        first = self._lost_seqs[0] if self._lost else message.seq
        self._lost_seqs = (min(first, message.seq), max(self._lost_seqs[1], message.seq))
        self._lost[message.topic] += 1
        self.lost[message.topic] += 1

    def _notify(self) -> None:
        self._changed.notify()
        if self._wake is not None:
            self._wake()
            self._wake = None

    def _ready(self) -> bool:
        return bool(self._closed or self._first or self._lost or self._waiting or self._previews)

    def _next(self) -> Message | None:
        if self._first:
            return self._lost_message(self._first.popleft())
        if self._lost:
            counts = {str(topic): count for topic, count in self._lost.items()}
            first, last = self._lost_seqs
            self._lost.clear()
            return self._lost_message(
                LostPayload(
                    why=Why.SLOW, messages=sum(counts.values()), by_topic=counts, first_seq=first, last_seq=last
                )
            )
        queues = [queue for queue in (self._waiting, self._previews) if queue]
        if not queues:
            return None
        message = min(queues, key=lambda queue: queue[0].seq).popleft()
        self._last_seq = message.seq
        return message

    def _lost_message(self, lost: LostPayload) -> Message:
        """A `lost` message has the number of the message before it, from which a subscriber can resume."""
        return Message(self._last_seq, Topic.LOST, datetime.now(UTC), lost)


class Bus:
    """Delivers messages from any thread to all subscriptions without blocking. Thread-safe."""

    def __init__(self, history: int = HISTORY) -> None:
        self._lock = threading.Lock()
        self._seq = 0
        self._topic_seqs: Counter[Topic] = Counter()
        self._history: deque[Message] = deque(maxlen=history)
        self._states: dict[Topic, OrderedDict[str | None, Message]] = {topic: OrderedDict() for topic in _WITH_STATE}
        self._subscriptions: tuple[Subscription, ...] = ()
        self._observers: tuple[Callable[[Message], None], ...] = ()
        self._dropped: Counter[Topic] = Counter()

    @property
    def seq(self) -> int:
        """Number of the newest message; 0: none yet."""
        return self._seq

    def publish(
        self,
        topic: Topic,
        payload: BaseModel,
        capture_id: str | None = None,
        reconstruction_id: str | None = None,
    ) -> int:
        """Publish a message and return its number. Never blocks; the payload must not change afterwards."""
        assert topic in PUBLISHED, "lost messages are made by subscriptions only"
        with self._lock:
            self._seq += 1
            self._topic_seqs[topic] += 1
            now, number = datetime.now(UTC), self._topic_seqs[topic]
            message = Message(self._seq, topic, now, payload, capture_id, reconstruction_id, number)
            if topic is not Topic.PREVIEW:
                self._history.append(message)
            if topic in _WITH_STATE:
                self._remember(message)
            for subscription in self._subscriptions:
                subscription._put(message)
        for observer in self._observers:
            observer(message)
        return message.seq

    def subscribe(
        self,
        topics: Collection[Topic] = PUBLISHED,
        capacity: int = 1024,
        previews_capacity: int = 2,
        since: int | None = None,
    ) -> Subscription:
        """Subscribe to topics from now on, or to all kept messages after number `since`."""
        subscription = Subscription(self, topics, capacity, previews_capacity)
        with self._lock:
            if since is None:
                subscription._begin(self._seq, None, ())
            else:
                missed = self._missed(since)
                start = 0 if missed is not None and missed.why is Why.RESTARTED else since
                kept = [message for message in self._history if message.seq > start]
                subscription._begin(start, missed, kept)
            self._subscriptions += (subscription,)
        return subscription

    def observe(self, observer: Callable[[Message], None]) -> None:
        """Call `observer` with every message on the publishing thread. It must return quickly and must not publish."""
        with self._lock:
            self._observers += (observer,)

    def state(self) -> dict[Topic, list[Message]]:
        """The newest message of each device, capture, job, trajectory and scene."""
        with self._lock:
            return {topic: list(messages.values()) for topic, messages in self._states.items()}

    def subscribers(self) -> int:
        """Number of subscriptions."""
        return len(self._subscriptions)

    def published(self) -> dict[Topic, int]:
        """Messages since the start, by topic."""
        with self._lock:
            return dict(self._topic_seqs)

    def dropped(self) -> dict[Topic, int]:
        """Messages that slow subscribers lost since the start, by topic."""
        with self._lock:
            total = self._dropped.copy()
            for subscription in self._subscriptions:
                total.update(subscription.lost)
            return dict(total)

    def _missed(self, since: int) -> LostPayload | None:
        if since > self._seq:
            return LostPayload(why=Why.RESTARTED, messages=None, by_topic={}, first_seq=None, last_seq=None)
        full = len(self._history) == self._history.maxlen
        oldest = self._history[0].seq if full and self._history else 1
        if since + 1 >= oldest:
            return None
        return LostPayload(
            why=Why.FORGOTTEN, messages=oldest - since - 1, by_topic={}, first_seq=since + 1, last_seq=oldest - 1
        )

    def _remember(self, message: Message) -> None:
        states = self._states[message.topic]
        key = message.reconstruction_id or message.capture_id or getattr(message.payload, "id", None)
        if message.topic is Topic.DEVICE:
            key = getattr(message.payload, "id", key)
        states[key] = message
        states.move_to_end(key)
        if len(states) > _STATES:
            states.popitem(last=False)

    def _forget(self, subscription: Subscription) -> None:
        with self._lock:
            if subscription in self._subscriptions:
                self._subscriptions = tuple(one for one in self._subscriptions if one is not subscription)
                self._dropped.update(subscription.lost)


def _set_soon(loop: asyncio.AbstractEventLoop, arrived: asyncio.Event) -> None:
    try:
        loop.call_soon_threadsafe(arrived.set)
    except RuntimeError:
        return  # the loop was closed
