"""The ring between real processes, some of which are killed. This file is also the program that they run."""

import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from spiked.ring import (
    End,
    EndReason,
    Frames,
    LossCause,
    Policy,
    ReaderStatus,
    Ring,
    RingReader,
    RingWriter,
    clean_stale,
)
from spiked.sensor import Sensor

SENSOR = Sensor(400, 250, 20_000.0)
WORDS = SENSOR.frame_bytes // 4
SLOTS = 32
DEADLINE_S = 60.0
"""Far beyond what anything here takes: only a hang comes to it."""


def write(seed: int, blocks: int, readers: int, patient: bool) -> None:
    """Wait for the readers, then write blocks that hold their frame indices, with random gaps, bursts and pauses."""
    chance = random.Random(seed)
    with RingWriter.create(SENSOR, slots=SLOTS) as writer:
        print(writer.name, flush=True)
        assert writer.wait_for_readers(readers, DEADLINE_S)
        for _ in range(blocks):
            if patient:
                assert writer.wait_for_space(DEADLINE_S)
            elif chance.random() < 0.2:
                time.sleep(chance.random() * 0.004)
            view = writer.acquire()
            indices = np.arange(writer.next_frame, writer.next_frame + len(view), dtype=np.uint32)
            view.view(np.uint32)[:] = indices[:, None]
            writer.commit(chance.randint(1, len(view)) if chance.random() < 0.1 else len(view))
            if chance.random() < 0.05:
                writer.gap(chance.randint(1, 100), chance.choice(list(LossCause)))
        writer.end(EndReason.FINISHED)


def read(name: str, policy: Policy, seed: int, stalls: float) -> None:
    """Check content and order of everything that comes, stalling now and then; print the account at the end."""
    chance = random.Random(seed)
    received = lost = expected = 0
    with RingReader.attach(name, policy, f"{policy.value} {seed}") as reader:
        while True:
            item = reader.next(DEADLINE_S)
            assert item is not None, "the ring is silent"
            if isinstance(item, End):
                print(json.dumps({"received": received, "lost": lost, "frames": item.frames, "reason": item.reason}))
                return
            assert item.first == expected
            if not isinstance(item, Frames):
                lost += item.count
                expected += item.count
                continue
            words = item.data.view(np.uint32)
            if chance.random() < stalls:
                time.sleep(chance.random() * 0.05)
            copy = words.copy()
            if item.release():
                assert (copy == np.arange(item.first, item.first + item.count, dtype=np.uint32)[:, None]).all()
                received += item.count
                expected += item.count


class Peer:
    """A process of this file's program."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, __file__, *map(str, arguments)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def account(self) -> dict[str, int]:
        """What a reader prints at its end."""
        output, errors = self.process.communicate(timeout=DEADLINE_S)
        assert self.process.returncode == 0, errors
        account: dict[str, int] = json.loads(output)
        assert account["received"] + account["lost"] == account["frames"]
        return account

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(DEADLINE_S)


@contextmanager
def peers() -> Iterator[Callable[..., Peer]]:
    started: list[Peer] = []

    def start(*arguments: object) -> Peer:
        started.append(Peer(*arguments))
        return started[-1]

    try:
        yield start
    finally:
        for peer in started:
            peer.kill()
            peer.process.communicate()
        clean_stale()


def eventually(ring: Ring, condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"it never came to it: {ring.status()}"
        time.sleep(0.001)


def row(ring: Ring, consumer: str) -> ReaderStatus:
    return next(reader for reader in ring.status().readers if reader.consumer == consumer)


def test_patient_writer_and_lossless_readers_lose_nothing() -> None:
    with peers() as start:
        writer = start("write", 1, 500, 2, 1)
        name = writer.line()
        readers = [start("read", name, policy, 0, 0.01) for policy in (Policy.LOSSLESS, Policy.PRIORITY)]
        ring = Ring.attach(name)
        accounts = [reader.account() for reader in readers]
        told = ring.status().writer
    for account in accounts:
        assert account["received"] == told.committed
        assert account["lost"] == sum(told.lost.values())
        assert account["reason"] == "finished"


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 1000), st.floats(0.0, 0.05))
def test_stalling_readers_of_an_impatient_writer_account_for_every_frame(seed: int, stalls: float) -> None:
    with peers() as start:
        name = start("write", seed, 500, 3, 0).line()
        readers = [start("read", name, policy, seed, stalls) for policy in Policy]
        ring = Ring.attach(name)
        while any(reader.process.poll() is None for reader in readers):
            told = ring.status()
            assert told.writer.committed + sum(told.writer.lost.values()) == told.writer.next_frame
            assert all(row.frames_read + row.lost == row.next_frame for row in told.readers)
            time.sleep(0.001)
        accounts = [reader.account() for reader in readers]
        assert {account["frames"] for account in accounts} == {ring.status().writer.next_frame}


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 1000), st.integers(0, 10_000))
def test_readers_of_a_killed_writer_come_to_an_end_that_says_so(seed: int, kill_at: int) -> None:
    with peers() as start:
        writer = start("write", seed, 1_000_000_000, 2, 0)
        name = writer.line()
        readers = [start("read", name, policy, seed, 0.01) for policy in (Policy.LOSSLESS, Policy.LATEST)]
        ring = Ring.attach(name)
        eventually(ring, lambda: ring.status().writer.next_frame > kill_at)
        writer.kill()
        told = ring.status().writer
        assert not told.alive
        assert told.committed + sum(told.lost.values()) == told.next_frame
        for account in [reader.account() for reader in readers]:
            assert account["reason"] == "writer_died"
            assert account["frames"] == told.next_frame
        clean_stale()
        assert not Path("/dev/shm", name).exists()


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 1000), st.integers(0, 3_000))
def test_a_killed_reader_holds_back_neither_writer_nor_others(seed: int, kill_at: int) -> None:
    with peers() as start:
        writer = start("write", seed, 1_000, 2, 1)
        name = writer.line()
        victim = start("read", name, Policy.LOSSLESS, seed, 0.05)
        survivor = start("read", name, Policy.PRIORITY, seed, 0.0)
        ring = Ring.attach(name)
        eventually(ring, lambda: ring.status().writer.next_frame > kill_at)
        victim.kill()
        dead = row(ring, f"lossless {seed}")
        assert not dead.alive
        assert dead.frames_read + dead.lost == dead.next_frame
        account = survivor.account()
        told = ring.status().writer
        assert account["reason"] == "finished"
        assert account["received"] == told.committed
        left = row(ring, f"lossless {seed}")
        assert left == replace(dead, lag_frames=told.next_frame - dead.next_frame, fill=1.0)


def test_a_stopped_reader_is_not_waited_for_by_a_camera_and_learns_what_it_lost() -> None:
    with peers() as start:
        writer = start("write", 5, 1_500, 2, 0)
        name = writer.line()
        frozen = start("read", name, Policy.LOSSLESS, 1, 0.0)
        ring = Ring.attach(name)
        eventually(ring, lambda: len(ring.status().readers) == 1)
        frozen.process.send_signal(signal.SIGSTOP)
        healthy = start("read", name, Policy.LATEST, 2, 0.0)
        healthy.account()
        assert writer.process.wait(DEADLINE_S) == 0
        frozen.process.send_signal(signal.SIGCONT)
        account = frozen.account()
    assert account["lost"] > account["received"] > 0


def test_the_place_of_a_killed_reader_is_taken_by_the_next() -> None:
    with peers() as start, RingWriter.create(SENSOR, slots=SLOTS) as writer:
        victim = start("read", writer.name, Policy.LOSSLESS, 1, 0.0)
        assert writer.wait_for_readers(1, DEADLINE_S)
        victim.kill()
        with RingReader.attach(writer.name, Policy.LATEST, "successor"):
            assert [reader.consumer for reader in writer.status().readers] == ["successor"]


def test_a_waiting_reader_is_woken_by_the_writer() -> None:
    with peers() as start, RingWriter.create(SENSOR, slots=SLOTS) as writer:
        reader = start("read", writer.name, Policy.LOSSLESS, 1, 0.0)
        assert writer.wait_for_readers(1, DEADLINE_S)
        writer.end(EndReason.STOPPED)
        assert reader.account()["reason"] == "stopped"


def test_killing_a_creator_leaves_a_name_only_until_it_is_cleaned() -> None:
    with peers() as start:
        writer = start("write", 1, 10, 1, 0)
        name = writer.line()
        writer.kill()
        assert Path("/dev/shm", name).exists()
        clean_stale()  # a service that starts meanwhile does the same
        assert not Path("/dev/shm", name).exists()


if __name__ == "__main__":
    role, *arguments = sys.argv[1:]
    if role == "write":
        write(*map(int, arguments[:3]), patient=arguments[3] == "1")
    else:
        read(arguments[0], Policy(arguments[1]), int(arguments[2]), float(arguments[3]))
