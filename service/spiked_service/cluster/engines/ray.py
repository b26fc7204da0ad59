"""Agents as Ray actors: detached ones, which outlive the engine and end with their attempt."""

import os
import sys
import threading
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import ray

from spiked_service.cluster.agent import run_agent
from spiked_service.cluster.engine import EngineOptions

_NAMESPACE = "spiked"
"""Of the names of the actors."""


class _Agent:
    """One attempt. It begins with the actor: a call of a method is lost with the engine that has made it.

    An actor that waits for its resources while the engine dies would then hold them for ever, and do nothing.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        self._thread = threading.Thread(target=self._run, args=(arguments,), name="agent")
        self._thread.start()

    def wait(self) -> None:
        """Never returns: this process ends with the attempt."""
        self._thread.join()

    @staticmethod
    def _run(arguments: Sequence[str]) -> None:
        try:
            url, attempt, token = arguments
            run_agent(url, attempt, token)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)


class RayTasks:
    """Attempts by the names of their actors."""

    def __init__(self, options: EngineOptions) -> None:
        ray.init(
            address=options.address or None,
            namespace=_NAMESPACE,
            log_to_driver=False,
            include_dashboard=False,
        )
        self._options = options
        self._running: dict[Any, str] = {}

    def submit(self, attempt: str, arguments: Sequence[str]) -> None:
        """Create the actor; Ray waits for the resources."""
        resources = {"num_cpus": self._options.cpus, "num_gpus": self._options.gpus}
        remote: Any = ray.remote(_Agent)
        agent = remote.options(name=attempt, lifetime="detached", max_restarts=0, **resources)
        self._running[agent.remote(list(arguments)).wait.remote()] = attempt

    def cancel(self, attempt: str) -> None:
        """Kill the actor, which takes the worker along."""
        with suppress(ValueError):  # it has ended
            ray.kill(ray.get_actor(attempt))

    def ended(self) -> list[tuple[str, str]]:
        """Attempts whose actors have ended, in whatever way."""
        done, _ = (
            ray.wait(list(self._running), num_returns=len(self._running), timeout=0) if self._running else ([], [])
        )
        found = []
        for task in done:
            attempt, reason = self._running.pop(task), "the agent has ended without a result"
            try:
                ray.get(task)
            except ray.exceptions.ActorUnavailableError:  # its machine does not answer, for now
                if self._watch(attempt):
                    continue
            except ray.exceptions.ActorDiedError:
                pass  # as at the end of every attempt
            except ray.exceptions.RayError as error:
                reason = f"Ray has ended it: {type(error).__name__}"
            found.append((attempt, reason))
        return found

    def _watch(self, attempt: str) -> bool:
        """Wait for the end of an actor that exists. Return whether it does."""
        try:
            self._running[ray.get_actor(attempt).wait.remote()] = attempt
        except ValueError:
            return False
        return True


def tasks(options: EngineOptions) -> RayTasks:
    """The tasks of a cluster."""
    return RayTasks(options)
