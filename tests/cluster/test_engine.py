"""The engine's process with submitit's local executor: whose end it tells, and what it cancels."""

import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue

import psutil
import pytest
from spiked_service.cluster.engine import Engine, EngineOptions
from waiting import until

pytest.importorskip("submitit")


class Agents:
    """An engine and its agents, which try for a minute to reach a service that does not answer."""

    def __init__(self, folder: Path) -> None:
        self._silent = socket.create_server(("127.0.0.1", 0))
        self._url = f"http://127.0.0.1:{self._silent.getsockname()[1]}"
        self._mark = str(folder)
        self.ended: SimpleQueue[tuple[str, str, bool]] = SimpleQueue()
        options = EngineOptions("submitit", 1, 0, address="local", folder=str(folder / "submitit"))
        self.engine = Engine(options, folder / "log", lambda *told: self.ended.put(told))

    def submit(self, attempt: str) -> psutil.Process:
        """The process of its agent."""
        before = {one.pid for one in self.running()}
        self.engine.submit(attempt, [self._url, attempt, "token"])
        return until(lambda: [one for one in self.running() if one.pid not in before], f"{attempt} runs")[0]

    def running(self) -> list[psutil.Process]:
        """Agents of this engine."""
        found = []
        for one in psutil.process_iter(["cmdline"]):
            with suppress(psutil.Error):
                submitted = "submitit.core._submit" in (one.info["cmdline"] or [])
                if submitted and one.environ().get("TEST_AGENTS") == self._mark:
                    found.append(one)
        return found

    def close(self) -> None:
        """End all."""
        self.engine.close()
        self._silent.close()
        for one in self.running():
            one.kill()


@pytest.fixture
def agents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Agents]:
    monkeypatch.setenv("TEST_AGENTS", str(tmp_path))
    one = Agents(tmp_path)
    yield one
    one.close()


def gone(process: psutil.Process) -> bool:
    """Whether it has ended."""
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def test_an_agent_that_works_for_another_attempt_keeps_its_place(agents: Agents) -> None:
    first, second = agents.submit("first"), agents.submit("second")
    agents.engine.cancel("first", 0.5)  # it has ended, and its agent is given time to leave, but ...
    agents.engine.hand_on("first", "second")
    until(lambda: gone(second), "what was submitted for the second attempt is cancelled")
    third = agents.submit("third")
    agents.engine.cancel("first", 0.0)
    agents.engine.cancel("third", 0.0)
    until(lambda: gone(third), "what was asked after the first attempt's end is done")
    assert first.is_running()
    assert agents.ended.empty() or agents.ended.get()[0] == "third"
    first.kill()
    attempt, reason, certain = agents.ended.get(timeout=60)
    while attempt == "third":
        attempt, reason, certain = agents.ended.get(timeout=60)
    assert (attempt, certain) == ("second", True), reason


def test_the_place_of_an_attempt_is_found_after_it_was_handed_on(agents: Agents) -> None:
    first, second = agents.submit("first"), agents.submit("second")
    agents.engine.hand_on("first", "second")
    until(lambda: gone(second), "what was submitted for the second attempt is cancelled")
    agents.engine.cancel("second", 0.0)
    until(lambda: gone(first), "its agent is ended")


def test_an_engine_that_dies_says_so_of_the_attempts_that_its_agents_work_for(agents: Agents) -> None:
    agents.submit("first"), agents.submit("second")
    agents.engine.hand_on("first", "second")
    engine = next(one for one in psutil.Process().children() if "spiked_service.cluster.engines" in one.cmdline())
    os.kill(engine.pid, 9)
    attempt, reason, certain = agents.ended.get(timeout=60)
    assert (attempt, certain) == ("second", False)
    assert "the engine submitit has ended" in reason
