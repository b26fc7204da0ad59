"""`system`: version, uptime, disk and memory of the service."""

import os
import resource
import time
from datetime import UTC, datetime

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from spiked_service.api.problems import problems
from spiked_service.api.services import Services
from spiked_service.base.version import installed_version
from spiked_service.operations.disk_forecast import disk_forecast, running_sensors
from spiked_service.settings.tokens import Scope


class DiskOut(BaseModel):
    """The disk below the data folder."""

    free_bytes: int
    total_bytes: int
    recording_s: float = Field(
        description="How long a recording there is room for, of the cameras that run at the rates that they state, or "
        "of a USB camera if none runs; `GET doctor` says the same."
    )
    recording_of: str = Field(description="These cameras.", examples=["400x250 at 20 kHz"])


class ZmqOut(BaseModel):
    """Addresses of the ZeroMQ sockets, on this machine."""

    events: str = Field(description="PUB: all but pictures.", examples=["tcp://127.0.0.1:8651"])
    state: str = Field(description="REP: the newest message of each kind, or those after a number.")
    previews: str = Field(description="PUB: pictures.")


class SystemOut(BaseModel):
    """The running service."""

    version: str = Field(examples=["0.2.0"])
    started_at: datetime
    uptime_s: float
    data_folder: str
    disk: DiskOut
    memory_bytes: int = Field(description="Resident memory of the service itself, without its workers.")
    pid: int
    events_seq: int = Field(description="Number of the newest event.")
    event_clients: int = Field(description="Clients of the events now, WebSocket and server-sent events.")
    zmq: ZmqOut | None = Field(description="null where ZeroMQ is turned off.")
    scope: Scope = Field(description="Scope of the token of this request; admin where no token is required.")
    token_required: bool = Field(
        description="Whether requests need a token. Where none is required, scopes limit nothing."
    )
    token_scope: Scope | None = Field(
        description="Scope of the token that this request brings, whether one is required or not; null without one."
    )


def system_routes(services: Services) -> APIRouter:
    """`system`."""
    router = APIRouter(tags=["operations"])
    started_at, started_s = datetime.now(UTC), time.monotonic()

    @router.get("/system", responses=problems())
    def get_system(request: Request) -> SystemOut:
        """Version, uptime, disk, memory, and what the token of the request allows."""
        space = services.folder.space()
        forecast = disk_forecast(space, running_sensors(services.captures))
        return SystemOut(
            version=installed_version(),
            started_at=started_at,
            uptime_s=time.monotonic() - started_s,
            data_folder=str(services.folder.path),
            disk=DiskOut(
                free_bytes=space.free_bytes,
                total_bytes=space.total_bytes,
                recording_s=forecast.seconds,
                recording_of=forecast.of,
            ),
            memory_bytes=resident_bytes(),
            pid=os.getpid(),
            events_seq=services.bus.seq,
            event_clients=services.event_clients.active,
            zmq=None if services.zmq is None else ZmqOut(**vars(services.zmq)),
            scope=request.state.caller.scope,
            token_required=request.state.caller.required,
            token_scope=request.state.caller.token_scope,
        )

    return router


def resident_bytes() -> int:
    """Resident memory of this process, from /proc."""
    with open("/proc/self/statm") as file:  # noqa: PTH123 - read at every scrape
        return int(file.read().split()[1]) * resource.getpagesize()
