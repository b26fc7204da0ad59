"""Agents as jobs of Slurm, or as processes of this machine, by submitit."""

import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import submitit

from spiked_service.cluster.agent import SERVES_S, run_agent
from spiked_service.cluster.engine import EngineOptions

_OLD_S = 14 * 86_400.0
"""Age of a folder whose job has surely ended, or been replaced by another attempt."""


_OF_THE_LIMIT = 0.25
"""Share of Slurm's limit of time after which an agent takes no more attempts: the rest is for its last one."""


class SubmititTasks:
    """Attempts by their jobs."""

    def __init__(self, options: EngineOptions) -> None:
        self._folder = Path(options.folder)
        self._executor = submitit.AutoExecutor(folder=self._folder / "%j", cluster=options.address or None)
        given: dict[str, Any] = {"timeout_min": 24 * 60}
        given |= {name: _number(value) for name, value in options.options.items()}
        self._executor.update_parameters(
            **{"name": "spiked", "cpus_per_task": options.cpus}
            | ({"gpus_per_node": int(options.gpus)} if options.gpus else {})
            | given
        )
        self._serves_s = min(SERVES_S, given["timeout_min"] * 60 * _OF_THE_LIMIT)
        self._jobs: dict[str, Any] = {}
        self._remove_old()

    def submit(self, attempt: str, arguments: Sequence[str]) -> None:
        """Submit the job; Slurm waits for the resources."""
        self._jobs[attempt] = self._executor.submit(run_agent, *arguments, self._serves_s)

    def cancel(self, attempt: str) -> None:
        """Cancel the job. One of an earlier engine has no job here: its agent is refused and exits."""
        job = self._jobs.pop(attempt, None)
        if job is not None:
            if not job.done():
                job.cancel()
            shutil.rmtree(job.paths.folder, ignore_errors=True)

    def _remove_old(self) -> None:
        """Remove the folders of jobs of earlier engines that have ended: with a result, or long ago."""
        for folder in self._folder.glob("[0-9]*/"):
            with suppress(FileNotFoundError):  # the job removes files of its own
                old_s = time.time() - folder.stat().st_mtime
                if any(folder.glob("*_result.pkl")) or old_s > _OLD_S:
                    shutil.rmtree(folder, ignore_errors=True)

    def ended(self) -> list[tuple[str, str]]:
        """Attempts whose jobs have ended, in whatever way."""
        over = [attempt for attempt, job in self._jobs.items() if job.done()]
        return [(attempt, f"its job has ended: {self._jobs[attempt].state}") for attempt in over]


def _number(value: str) -> int | str:
    """Parameters such as `mem_gb` are numbers."""
    return int(value) if value.isdigit() else value


def tasks(options: EngineOptions) -> SubmititTasks:
    """The tasks of a cluster."""
    return SubmititTasks(options)
