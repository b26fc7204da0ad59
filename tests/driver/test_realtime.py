"""Priority and locked memory: taken where permitted, told of where not. Each in a process of its own."""

import json
import subprocess
import sys

import pytest

TAKE = """
import ctypes, json, os, resource, sys
from pathlib import Path
from spiked_driver import realtime
if sys.argv[1] == "refused":
    for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
        resource.setrlimit(limit, (0, 0))
    if os.geteuid() == 0:
        os.setuid(65534)
notes = realtime.take_priority()
locked = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmLck")]
inherited = os.popen("cat /proc/self/stat").read().rpartition(")")[2].split()[38]
print(json.dumps({
    "notes": notes,
    "policy": os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK,
    "locked_kib": int(locked[0].split()[1]),
    "child_policy": int(inherited), "may": [realtime.may_schedule(), realtime.may_lock_memory()],
}))
"""


def take(how: str) -> dict[str, object]:
    done = subprocess.run([sys.executable, "-c", TAKE, how], stdout=subprocess.PIPE, text=True, check=True, timeout=60)
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def test_who_may_not_gets_notes_that_say_how_to_permit_it_and_runs_all_the_same() -> None:
    taken = take("refused")
    notes = taken["notes"]
    assert isinstance(notes, list)
    assert len(notes) == 2
    assert "LimitRTPRIO=20" in notes[0]
    assert "LimitMEMLOCK=infinity" in notes[1]
    assert taken["policy"] == 0
    assert taken["locked_kib"] == 0
    assert taken["may"] == [False, False]


def test_who_may_runs_before_others_with_its_memory_locked_and_its_children_do_not() -> None:
    taken = take("permitted")
    if taken["notes"]:
        pytest.skip(f"not permitted here: {taken['notes']}")
    assert taken["policy"] == 1  # SCHED_FIFO
    assert isinstance(taken["locked_kib"], int)
    assert taken["locked_kib"] > 10_000
    assert taken["child_policy"] == 0
    assert taken["may"] == [True, True]
