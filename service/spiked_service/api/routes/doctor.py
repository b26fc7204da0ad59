"""`doctor`: checks of the machine for its cameras."""

import threading
import time
from pathlib import Path

from fastapi import APIRouter
from pydantic import Field

from spiked_service.api.problems import problems
from spiked_service.api.schemas.base import Out
from spiked_service.captures.captures import Captures
from spiked_service.operations.disk_forecast import running_sensors
from spiked_service.operations.doctor import Diagnosis, DiagnosisStatus, examine

_FRESH_S = 5.0
"""Results are reused for this long, because the checks write to the disk."""


class DoctorItemOut(Out):
    """Result of one check."""

    name: str = Field(examples=["usbfs memory"])
    status: DiagnosisStatus
    finding: str = Field(examples=["16 MiB for all cameras, 65 MiB are wanted"])
    what_to_do: str | None = Field(description="null where all is well.")

    @classmethod
    def of(cls, finding: Diagnosis) -> "DoctorItemOut":
        """The response model of a result."""
        return cls(name=finding.name, status=finding.status, finding=finding.finding, what_to_do=finding.what_to_do)


class DoctorOut(Out):
    """Results of all checks."""

    items: list[DoctorItemOut]


class _Doctor:
    """Runs the checks, and reuses their results for a while."""

    def __init__(self, data: Path, captures: Captures) -> None:
        self._data = data
        self._captures = captures
        self._lock = threading.Lock()
        self._at_s = -_FRESH_S
        self._findings: list[Diagnosis] = []

    def examine(self) -> list[Diagnosis]:
        """New or reused results."""
        with self._lock:
            if time.monotonic() - self._at_s > _FRESH_S:
                self._findings = examine(self._data, running_sensors(self._captures))
                self._at_s = time.monotonic()
            return self._findings


def doctor_routes(data: Path, captures: Captures) -> APIRouter:
    """`doctor`, with the disk of the data folder."""
    router = APIRouter(tags=["devices"])
    doctor = _Doctor(data, captures)

    @router.get("/doctor", responses=problems())
    def examine_machine() -> DoctorOut:
        """Check USB rules, permissions, budget and port speed, the processor and the disk; takes about a second."""
        return DoctorOut(items=[DoctorItemOut.of(finding) for finding in doctor.examine()])

    return router
