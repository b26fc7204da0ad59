"""The bus of events: order, numbers, what a slow listener loses, and that nobody can make a publisher wait."""

import asyncio
import json
import threading
import time

import msgpack
from pydantic import BaseModel
from spiked_service.events.bus import PUBLISHED, Bus, Message, Subscription, Topic
from spiked_service.events.payloads import PreviewPayload


class Note(BaseModel):
    number: int


def drain(subscription: Subscription) -> list[Message]:
    taken = []
    while (message := subscription.take()) is not None:
        taken.append(message)
    return taken


def test_every_listener_gets_what_it_asked_for_in_order() -> None:
    bus = Bus()
    every, poses = bus.subscribe(), bus.subscribe([Topic.POSE])
    for number in range(10):
        bus.publish(Topic.POSE if number % 2 else Topic.SCENE, Note(number=number), capture_id="c")
    assert [message.seq for message in drain(every)] == list(range(1, 11))
    assert [message.payload for message in drain(poses)] == [Note(number=n) for n in range(1, 10, 2)]


def test_a_message_reads_the_same_in_json_and_msgpack() -> None:
    bus = Bus()
    listener = bus.subscribe()
    picture = PreviewPayload(frame=3, kind="rate", width=2, height=1, image=b"\x00\xff")
    bus.publish(Topic.PREVIEW, picture, capture_id="c", reconstruction_id="r")
    message = listener.take()
    assert message is not None
    as_json, as_packed = json.loads(message.json), msgpack.unpackb(message.packed)
    assert list(as_json) == ["seq", "topic", "topic_seq", "at", "capture_id", "reconstruction_id", "data"]
    assert as_json["at"].endswith("Z")
    assert as_json["data"].pop("image") == "AP8="
    assert as_packed["data"].pop("image") == b"\x00\xff"
    assert as_json == as_packed


def test_a_full_subscription_loses_pictures_first_then_the_oldest_and_says_so() -> None:
    bus = Bus()
    slow = bus.subscribe(capacity=4, previews_capacity=2)
    for number in range(3):
        bus.publish(Topic.PREVIEW, Note(number=number))  # 1, 2, 3: the first goes
    for number in range(4):
        bus.publish(Topic.POSE, Note(number=number))  # 4 to 7: pictures 2 and 3 go
    bus.publish(Topic.POSE, Note(number=4))  # 8: now 4 goes
    lost, *kept = drain(slow)
    assert lost.topic is Topic.LOST
    assert json.loads(lost.json)["data"] == {
        "why": "slow",
        "messages": 4,
        "by_topic": {"preview": 3, "pose": 1},
        "first_seq": 1,
        "last_seq": 4,
    }
    assert [message.seq for message in kept] == [5, 6, 7, 8]
    bus.publish(Topic.POSE, Note(number=5))
    assert [message.topic for message in drain(slow)] == [Topic.POSE]


def test_no_room_for_pictures_means_none() -> None:
    bus = Bus()
    listener = bus.subscribe(previews_capacity=0)
    bus.publish(Topic.PREVIEW, Note(number=0))
    assert [message.topic for message in drain(listener)] == [Topic.LOST]


def test_a_listener_that_comes_back_gets_what_it_missed_or_is_told() -> None:
    bus = Bus(history=4)
    for number in range(10):
        bus.publish(Topic.JOB, Note(number=number))
    assert [message.seq for message in drain(bus.subscribe(since=8))] == [9, 10]
    lost, *kept = drain(bus.subscribe(since=2))
    assert json.loads(lost.json)["data"]["why"] == "forgotten"
    assert json.loads(lost.json)["data"]["messages"] == 4
    assert [message.seq for message in kept] == [7, 8, 9, 10]
    restarted, *kept = drain(bus.subscribe(since=99))
    assert json.loads(restarted.json)["data"]["why"] == "restarted"
    assert [message.seq for message in kept] == [7, 8, 9, 10]


def test_the_state_is_the_newest_message_of_each() -> None:
    bus = Bus()
    for number in range(3):
        bus.publish(Topic.CAPTURE, Note(number=number), capture_id="a")
        bus.publish(Topic.CAPTURE, Note(number=number + 10), capture_id="b")
    payloads = [message.payload for message in bus.state()[Topic.CAPTURE]]
    assert payloads == [Note(number=2), Note(number=12)]


def test_numbers_are_consecutive_whoever_publishes() -> None:
    bus = Bus()
    listener = bus.subscribe(capacity=10_000)

    def publish() -> None:
        for number in range(500):
            bus.publish(Topic.POSE, Note(number=number))

    threads = [threading.Thread(target=publish) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [message.seq for message in drain(listener)] == list(range(1, 2001))


def test_a_listener_that_takes_nothing_costs_the_publisher_nothing() -> None:
    bus = Bus()
    idle = [bus.subscribe(capacity=8) for _ in range(50)]
    for number in range(2000):
        bus.publish(Topic.POSE, Note(number=number))
    assert all(len(one) == 8 and one.lost[Topic.POSE] == 1992 for one in idle)


def test_waiting_in_a_thread_and_in_an_event_loop() -> None:
    bus = Bus()
    blocking = bus.subscribe()

    async def listen() -> list[int]:
        listener = bus.subscribe()
        started.set()
        seqs = []
        while (message := await listener.next()) is not None:
            seqs.append(message.seq)
            if len(seqs) == 100:
                listener.close()
        return seqs

    started = threading.Event()

    def publish() -> None:
        started.wait(10)
        for number in range(100):
            bus.publish(Topic.LOG, Note(number=number))

    thread = threading.Thread(target=publish)
    thread.start()
    assert asyncio.run(asyncio.wait_for(listen(), 10)) == list(range(1, 101))
    thread.join()
    assert len(drain(blocking)) == 100
    before = time.monotonic()
    assert blocking.take(timeout_s=0.05) is None
    assert time.monotonic() - before >= 0.05
    assert bus.subscribers() == 1
    assert Topic.LOST not in PUBLISHED
