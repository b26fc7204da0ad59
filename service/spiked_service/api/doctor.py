"""Whether the machine is fit for its cameras."""

import threading
from pathlib import Path

from fastapi import APIRouter
from pydantic import Field

from spiked_service.api.problems import problems
from spiked_service.api.schemas.base import Out
from spiked_service.doctor import Finding, Status, examine


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


def doctor_routes(data: Path) -> APIRouter:
    """The route `doctor`, for the disk below that folder."""
    router = APIRouter(tags=["devices"])
    one_at_a_time = threading.Lock()  # it writes to the disk to see how fast that is

    @router.get("/doctor", responses=problems())
    def examine_machine() -> DoctorOut:
        """Look at USB rules, permissions, budget and port speed, the processor, and the disk; takes about a second."""
        with one_at_a_time:
            return DoctorOut(items=[DoctorItemOut.of(finding) for finding in examine(data)])

    return router
