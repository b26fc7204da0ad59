"""Health checks: liveness of the process and readiness for requests."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum


class CheckStatus(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARNING = "warning"
    """Something to look after; the service can be used."""
    FAILED = "failed"


@dataclass(frozen=True)
class CheckResult:
    """Result of one check."""

    name: str
    verdict: CheckStatus
    finding: str = ""
    """A sentence; for a failure, with what to do."""


Check = Callable[[], tuple[CheckStatus, str]]


@dataclass
class Health:
    """Checks by name. Liveness checks fail if only a restart helps, readiness checks if requests would fail."""

    _life: dict[str, Check] = field(default_factory=dict)
    _readiness: dict[str, Check] = field(default_factory=dict)

    def add(self, name: str, check: Check, *, life: bool = False) -> None:
        """Add a check. It must be quick and may be called from any thread."""
        (self._life if life else self._readiness)[name] = check

    def life(self) -> list[CheckResult]:
        """Run the liveness checks."""
        return [_run(name, check) for name, check in self._life.items()]

    def readiness(self) -> list[CheckResult]:
        """Run all checks: liveness is part of readiness."""
        return self.life() + [_run(name, check) for name, check in self._readiness.items()]


class EventLoopHeartbeat:
    """Measures from other threads whether an event loop still runs."""

    def __init__(self, period_s: float = 1.0, limit_s: float = 10.0) -> None:
        self._period_s = period_s
        self._limit_s = limit_s
        self._last_s: float | None = None

    async def beat(self) -> None:
        """Update the time of the last beat; runs for ever."""
        while True:
            self._last_s = time.monotonic()
            await asyncio.sleep(self._period_s)

    def check(self) -> tuple[CheckStatus, str]:
        """Fail if the last beat is more than `limit_s` ago."""
        late_s = 0.0 if self._last_s is None else time.monotonic() - self._last_s
        if late_s > self._limit_s:
            return CheckStatus.FAILED, f"the event loop has not responded for {late_s:.0f} s: restart the service"
        return CheckStatus.OK, ""


def failed(results: list[CheckResult]) -> bool:
    """Whether any result is a failure."""
    return any(finding.verdict is CheckStatus.FAILED for finding in results)


def _run(name: str, check: Check) -> CheckResult:
    try:
        return CheckResult(name, *check())
    except Exception as error:  # a check that raises has failed; the others must still run
        return CheckResult(name, CheckStatus.FAILED, f"the check itself failed: {error!r}")
