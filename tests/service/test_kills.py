"""Processes of captures killed at random moments: every frame that came is recorded, or told of as lost.

`KILLS_SEED=1000 pytest -m slow tests/service/test_kills.py` takes other seeds, from 1000 on.
"""

import os
import random
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from spiked_service.captures.archive import DataStore
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import Grade, Plan
from spiked_service.store.snapshot import Snapshot
from waiting import until

from spiked.recording import open_recording

from .survival import assert_holds, jobs_of, kept, over, random_recording, received
from .test_recovery import SHM, Service

FIRST_SEED = int(os.environ.get("KILLS_SEED", "0"))
ROLES = ("acquisition", "recorder", "preview", "reconstruction")
PHASES = ("start", "middle", "end")
LENGTH = 10_000
"""Frames of a capture, half a second of the camera; a fifth of them is the end."""
SHORT = 1_000
"""Of one whose source waits for the reconstruction."""


class Kill:
    """One capture, and the process of one role killed within one phase of it."""

    def __init__(self, seed: int) -> None:
        self._chance = random.Random(seed)
        self.role = ROLES[seed % len(ROLES)]
        self.phase = PHASES[seed // len(ROLES) % len(PHASES)]
        self._stopped = self._chance.random() < 0.3  # by somebody, before it is as long as it was to be
        self.struck = False

    def run(self, data_store: DataStore, noise: Path) -> Snapshot:
        """The capture when it is over."""
        pace = self._chance.choice((0, 0.5, 1))
        follow = self.role == "reconstruction" or self._chance.random() < 0.2
        length = SHORT if follow and not pace else LENGTH
        source = f"replay:{noise}?pace={pace}&repeat=100"
        plan = Plan(source, frames=length, reconstruct=follow, options=ReconstructionOptions(steps=5))
        capture_id = data_store.captures.start(plan).id
        stop_at = self._chance.randrange(length) if self._stopped else length
        strike_at = {
            "start": 0,
            "middle": self._chance.randrange(length // 10, length - length // 5),
            "end": self._chance.randrange(length - length // 5, length),
        }[self.phase]
        if self.phase == "start":
            self._wait(data_store, capture_id, lambda: self._process(data_store, capture_id) is not None)
            time.sleep(self._chance.random())
        else:
            self._wait(data_store, capture_id, lambda: received(data_store, capture_id) >= min(strike_at, stop_at))
        if self.phase == "end" and self._stopped:
            data_store.captures.stop(capture_id)
            time.sleep(0.1 * self._chance.random())
        self._strike(data_store, capture_id)
        self._wait(data_store, capture_id, lambda: received(data_store, capture_id) >= stop_at)
        if self._stopped:
            data_store.captures.stop(capture_id)
        return over(data_store, capture_id)

    def _process(self, data_store: DataStore, capture_id: str) -> int | None:
        if self.role != "reconstruction":
            return data_store.captures.processes().get(capture_id, {}).get(self.role)
        jobs = jobs_of(data_store, capture_id)
        return data_store.reconstructions.processes().get(jobs[0].id) if jobs else None

    def _strike(self, data_store: DataStore, capture_id: str) -> None:
        pid = self._process(data_store, capture_id)
        if pid is not None:
            with suppress(psutil.NoSuchProcess):
                psutil.Process(pid).kill()
                self.struck = True

    @staticmethod
    def _wait(data_store: DataStore, capture_id: str, condition: Callable[[], bool]) -> None:
        until(lambda: condition() or data_store.captures.get(capture_id).row.ended_at is not None, "the moment comes")


def assert_accounted(data_store: DataStore, done: Snapshot, frames: NDArray[np.uint8]) -> None:
    """Recorded and lost together are what came, in the catalogue as in the recording; and it is said in plain words."""
    row = done.row
    came = 0 if row.counters is None else row.counters.next_frame
    recorded = (0, 0) if row.recording is None else (row.recording.frames, row.recording.lost)
    assert sum(recorded) == came, row
    path = data_store.captures.recording(row.id)
    if recorded[0]:
        assert_holds(path, frames)
        recording = open_recording(path)
        assert (recording.frames, sum(gap.count for gap in recording.gaps)) == recorded
        assert recording.warnings == ()
    if came and recorded[1]:
        assert row.verdict is not None and row.verdict.grade is not Grade.GOOD, row
    told = " ".join([row.reason, *row.warnings, *(job.reason for job in jobs_of(data_store, done.id))])
    assert not any(word in told for word in ("Traceback", "Error", "/dev/shm", " ring ")), told
    assert not (SHM / f"spiked-{row.id}").exists()


def killed(folder: Path, seeds: range) -> Counter[str]:
    """How many were killed, by role and phase; fails where a frame is not accounted for."""
    frames = random_recording(folder / "noise.dat", 997)
    struck: Counter[str] = Counter()
    with kept(folder / "data") as data_store:
        for seed in seeds:
            kill = Kill(seed)
            try:
                assert_accounted(data_store, kill.run(data_store, folder / "noise.dat"), frames)
            except AssertionError as error:
                error.add_note(f"seed {seed}: {kill.role} killed at the {kill.phase}")
                raise
            struck[f"{kill.role} {kill.phase}"] += kill.struck
    return struck


def daemon_killed(folder: Path, seed: int) -> None:
    """The service itself: what it had counted is in the recording that the next one makes whole."""
    chance = random.Random(seed)
    folder /= f"service-{seed}"
    folder.mkdir()
    frames = random_recording(folder / "noise.dat", 997)
    data = folder / "data"
    one = Service(data, f"replay:{folder / 'noise.dat'}?repeat=9999")
    try:
        if seed % 3:
            until(lambda: one.received().get(one.ids[0], 0) > chance.randrange(20_000), "frames come")
        time.sleep(chance.random())
        before = one.received().get(one.ids[0], 0)
    finally:
        one.kill()
    with kept(data) as data_store:
        row = over(data_store, one.ids[0]).row
        assert row.reason == "the service ended during the capture"
        recorded = (0, 0) if row.recording is None else (row.recording.frames, row.recording.lost)
        assert sum(recorded) >= before, row
        if recorded[0]:
            assert_holds(data_store.captures.recording(row.id), frames)
        assert not (SHM / f"spiked-{row.id}").exists()


def test_every_role_killed_in_every_phase(tmp_path: Path) -> None:
    struck = killed(tmp_path, range(FIRST_SEED, FIRST_SEED + len(ROLES) * len(PHASES)))
    assert sum(struck.values()) >= 8, struck


@pytest.mark.parametrize("seed", range(FIRST_SEED, FIRST_SEED + 3))
def test_the_service_killed(tmp_path: Path, seed: int) -> None:
    daemon_killed(tmp_path, seed)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_two_hundred_kills(tmp_path: Path) -> None:
    begin_s = time.monotonic()
    struck = killed(tmp_path, range(FIRST_SEED, FIRST_SEED + 180))
    for seed in range(FIRST_SEED, FIRST_SEED + 20):
        daemon_killed(tmp_path, seed)
    print(
        f"{sum(struck.values())} workers and 20 services killed in {time.monotonic() - begin_s:.0f} s: {dict(struck)}"
    )
    assert sum(struck.values()) >= 150, struck
