"""Random maltreatment, and the invariants after each blow; the seed is in the test's name.

`CHAOS_SEED=100 pytest -m slow tests/soak/test_chaos.py` takes other seeds, from 100 on.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parent))
from chaos import OVER, Clock, Victim, fill
from waiting import until

from ..small_disk import small_disk

FIRST_SEED = int(os.environ.get("CHAOS_SEED", "0"))
ACTIONS = [
    "kill_worker",
    "pause_worker",
    "kill_daemon",
    "restart_daemon",
    "stop_capture",
    "rude_websocket",
    "rude_http",
    "rude_zmq",
    "slow_reader",
]


def maltreat(victim: Victim, actions: list[str]) -> None:
    try:
        for action in actions:
            victim.capturing()
            victim.do(action)
            victim.check()
        victim.check_at_rest()
    except AssertionError as error:
        error.add_note("done before: " + ", ".join(victim.mentioned))
        raise


def test_everything_once(daemon: Callable[..., Any], tmp_path: Path) -> None:
    maltreat(Victim(daemon, tmp_path / "data", seed=1), [*ACTIONS, "kill_worker", "kill_worker"])


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", range(FIRST_SEED, FIRST_SEED + 4))
def test_much_at_random(daemon: Callable[..., Any], tmp_path: Path, seed: int) -> None:
    victim = Victim(daemon, tmp_path / "data", seed)
    maltreat(victim, victim.random.choices(ACTIONS, weights=[5, 2, 2, 1, 1, 1, 1, 1, 1], k=40))


def test_a_clock_that_jumps(daemon: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(tmp_path, monkeypatch)
    victim = Victim(daemon, tmp_path / "data", seed=0)
    capture = victim.capturing()
    for offset_s in (86_400, -86_400, 0):
        clock.jump_to(offset_s)
        before = victim.daemon.http.get(f"captures/{capture}").json()["counters"]["received"]

        def goes_on(before: int = before) -> bool:
            return bool(victim.daemon.http.get(f"captures/{capture}").json()["counters"]["received"] > before + 100)

        until(goes_on, f"frames come {offset_s} s away")
        victim.check()
    system = victim.daemon.http.get("system").json()
    assert 0 <= system["uptime_s"] < 600
    victim.check_at_rest()
    assert victim.daemon.http.get(f"captures/{capture}").json()["state"] == "complete"


def test_a_full_disk_ends_the_capture_and_not_the_service(daemon: Callable[..., Any], tmp_path: Path) -> None:
    with small_disk(tmp_path / "data", 96):
        victim = Victim(daemon, tmp_path / "data", seed=0)
        capture = victim.capturing()
        filling = fill(tmp_path / "data", 256 * 1024)

        def over() -> Any:
            now = victim.daemon.http.get(f"captures/{capture}").json()
            return now["state"] in OVER and now

        try:
            time.sleep(1)
            ended = until(over, "the capture ends for want of room")
            assert ended["verdict"]["grade"] != "good" and ended["verdict"]["reasons"], ended
            assert victim.daemon.process.poll() is None
            assert victim.daemon.http.get("captures").status_code == 200
        finally:
            filling.unlink()
        again = victim.capturing()
        assert again != capture
        victim.check_at_rest()
        victim.daemon.close()
