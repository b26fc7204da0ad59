"""Whether the service lives, and whether it can be used: findings, not a constant."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum


class Verdict(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARNING = "warning"
    """Something to look after; the service can be used."""
    FAILED = "failed"


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    name: str
    verdict: Verdict
    finding: str = ""
    """A sentence, with what to do if something is not well."""


Check = Callable[[], tuple[Verdict, str]]


@dataclass
class Health:
    """Checks by name. Those of life fail when only a restart helps; those of readiness when requests would fail."""

    _life: dict[str, Check] = field(default_factory=dict)
    _readiness: dict[str, Check] = field(default_factory=dict)

    def add(self, name: str, check: Check, *, life: bool = False) -> None:
        """Ask this from now on. Checks must be quick, and may be asked from any thread."""
        (self._life if life else self._readiness)[name] = check

    def life(self) -> list[Finding]:
        """Whether the process does its work at all."""
        return [_asked(name, check) for name, check in self._life.items()]

    def readiness(self) -> list[Finding]:
        """Whether it can be used; a service that does not live is not ready."""
        return self.life() + [_asked(name, check) for name, check in self._readiness.items()]


class Pulse:
    """Beats in an event loop; a check of life from other threads sees when it stops."""

    def __init__(self, period_s: float = 1.0, limit_s: float = 10.0) -> None:
        self._period_s = period_s
        self._limit_s = limit_s
        self._last_s: float | None = None

    async def beat(self) -> None:
        """For ever."""
        while True:
            self._last_s = time.monotonic()
            await asyncio.sleep(self._period_s)

    def check(self) -> tuple[Verdict, str]:
        """Whether the loop came round in time."""
        late_s = 0.0 if self._last_s is None else time.monotonic() - self._last_s
        if late_s > self._limit_s:
            return Verdict.FAILED, f"the event loop has not come round for {late_s:.0f} s: restart the service"
        return Verdict.OK, ""


def failed(findings: list[Finding]) -> bool:
    """Whether any of them is a failure."""
    return any(finding.verdict is Verdict.FAILED for finding in findings)


def _asked(name: str, check: Check) -> Finding:
    try:
        return Finding(name, *check())
    except Exception as error:  # a check that breaks is a finding; its own error must not hide the others
        return Finding(name, Verdict.FAILED, f"the check itself failed: {error!r}")
