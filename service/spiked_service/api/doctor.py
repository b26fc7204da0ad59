"""Whether the machine is fit for its cameras."""

import threading
import time
from pathlib import Path

from fastapi import APIRouter
from pydantic import Field

from spiked_service.api.problems import problems
from spiked_service.api.schemas.base import Out
from spiked_service.doctor import Finding, Status, examine

_FRESH_S = 5.0
"""So long an answer is given again: looking writes to the disk."""


class DoctorItemOut(Out):
    """One thing that was looked at."""

    name: str = Field(examples=["usbfs memory"])
    status: Status
    finding: str = Field(examples=["16 MiB for all cameras, 65 MiB are wanted"])
    what_to_do: str | None = Field(description="null where all is well.")

    @classmethod
    def of(cls, finding: Finding) -> "DoctorItemOut":
        """As it is shown."""
        return cls(name=finding.name, status=finding.status, finding=finding.finding, what_to_do=finding.what_to_do)


class DoctorOut(Out):
    """All that was looked at."""

    items: list[DoctorItemOut]


class _Doctor:
    """Examines one machine, not more often than is good for its disk."""

    def __init__(self, data: Path) -> None:
        self._data = data
        self._lock = threading.Lock()
        self._at_s = -_FRESH_S
        self._findings: list[Finding] = []

    def examine(self) -> list[Finding]:
        """What was found now, or a moment ago."""
        with self._lock:
            if time.monotonic() - self._at_s > _FRESH_S:
                self._findings = examine(self._data)
                self._at_s = time.monotonic()
            return self._findings


def doctor_routes(data: Path) -> APIRouter:
    """The route `doctor`, for the disk below that folder."""
    router = APIRouter(tags=["devices"])
    doctor = _Doctor(data)

    @router.get("/doctor", responses=problems())
    def examine_machine() -> DoctorOut:
        """Look at USB rules, permissions, budget and port speed, the processor, and the disk; takes about a second."""
        return DoctorOut(items=[DoctorItemOut.of(finding) for finding in doctor.examine()])

    return router
