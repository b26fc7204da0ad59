"""What somebody who runs the service asks: health, version, settings, tokens."""

import os
import resource
import time
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from spiked_service.api.problems import problems
from spiked_service.api.services import Services
from spiked_service.commands.version import installed_version
from spiked_service.config import SettingOrigin, field, reloadable
from spiked_service.health import Finding, Verdict, failed


class FindingOut(BaseModel):
    """What one check found."""

    name: str = Field(examples=["disk"])
    verdict: Verdict
    finding: str = Field(examples=["53 GiB free"])


class HealthOut(BaseModel):
    """How the service is."""

    status: Verdict = Field(description="The worst of the checks.")
    checks: list[FindingOut]


class DiskOut(BaseModel):
    """The disk below the data folder."""

    free_bytes: int
    total_bytes: int


class ZmqOut(BaseModel):
    """Addresses of the ZeroMQ sockets, on this machine."""

    events: str = Field(description="PUB: all but pictures.", examples=["tcp://127.0.0.1:8651"])
    state: str = Field(description="REP: the newest message of each kind, or those after a number.")
    previews: str = Field(description="PUB: pictures.")


class SystemOut(BaseModel):
    """The running service."""

    version: str = Field(examples=["0.1.0"])
    started_at: datetime
    uptime_s: float
    data_folder: str
    disk: DiskOut
    memory_bytes: int = Field(description="Resident memory of the service itself, without its workers.")
    pid: int
    events_seq: int = Field(description="Number of the newest event.")
    event_clients: int = Field(description="Clients of the events now, WebSocket and server-sent events.")
    zmq: ZmqOut | None = Field(description="null where ZeroMQ is turned off.")


class SettingOut(BaseModel):
    """One setting; secrets are masked."""

    key: str = Field(examples=["limit_renders"])
    value: Any = Field(examples=[8])
    origin: SettingOrigin
    reloadable: bool = Field(description="Whether `configuration:reload` brings a new value into effect.")
    doc: str


class SettingsOut(BaseModel):
    """All settings in effect."""

    items: list[SettingOut]


class ReloadedOut(BaseModel):
    """What has come of a reload."""

    changed: list[str] = Field(description="In effect now.")
    needs_restart: list[str] = Field(description="Different in file or environment, but in effect after a restart.")


class TokenOut(BaseModel):
    """A token, without what would open anything."""

    name: str
    created_at: datetime
    expires_at: datetime | None


class TokensOut(BaseModel):
    """All tokens, oldest first."""

    items: list[TokenOut]


def health_routes(services: Services) -> APIRouter:
    """`/healthz` and `/readyz`, which need no token."""
    router = APIRouter(tags=["operations"])
    unwell: dict[int | str, dict[str, Any]] = {503: {"model": HealthOut, "description": "A check has failed."}}

    @router.get("/healthz", responses=unwell)
    def get_health(response: Response) -> HealthOut:
        """Whether the service lives; if not, only a restart helps."""
        return _health(services.health.life(), response)

    @router.get("/readyz", responses=unwell)
    def get_readiness(response: Response) -> HealthOut:
        """Whether captures can be started."""
        return _health(services.health.readiness(), response)

    return router


def metrics_routes(services: Services) -> APIRouter:
    """`/metrics`."""
    router = APIRouter(tags=["operations"])

    @router.get("/metrics", response_class=PlainTextResponse, responses={200: {"content": {"text/plain": {}}}})
    def get_metrics() -> Response:
        """Figures for Prometheus; docs/operations.md explains each."""
        return Response(services.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)

    return router


def operations_routes(services: Services) -> APIRouter:
    """`system`, `configuration` and `tokens`."""
    router = APIRouter(tags=["operations"])
    started_at, started_s = datetime.now(UTC), time.monotonic()

    @router.get("/system", responses=problems())
    def get_system() -> SystemOut:
        """Version, uptime, disk and memory."""
        folder = services.keeping.folder
        space = folder.space()
        return SystemOut(
            version=installed_version(),
            started_at=started_at,
            uptime_s=time.monotonic() - started_s,
            data_folder=str(folder.path),
            disk=DiskOut(free_bytes=space.free_bytes, total_bytes=space.total_bytes),
            memory_bytes=resident_bytes(),
            pid=os.getpid(),
            events_seq=services.bus.seq,
            event_clients=services.event_clients.inside,
            zmq=None if services.zmq is None else ZmqOut(**vars(services.zmq)),
        )

    @router.get("/configuration", responses=problems())
    def get_configuration() -> SettingsOut:
        """Every setting in effect, and where its value comes from."""
        configuration = services.settings.configuration
        items = [
            SettingOut(
                key=name,
                value=value,
                origin=configuration.origins[name],
                reloadable=reloadable(name),
                doc=field(name).description or "",
            )
            for name, value in configuration.shown().items()
        ]
        return SettingsOut(items=items)

    @router.post("/configuration:reload", responses=problems())
    def reload_configuration() -> ReloadedOut:
        """Read file and environment again, as SIGHUP does. After an error nothing has changed."""
        done = services.settings.reload()
        return ReloadedOut(changed=done.changed, needs_restart=done.waiting)

    @router.get("/tokens", responses=problems())
    def list_tokens() -> TokensOut:
        """Names and dates of the tokens; `spiked token` makes and revokes them."""
        items = [
            TokenOut(name=token.name, created_at=token.created_at, expires_at=token.expires_at)
            for token in services.tokens.all()
        ]
        return TokensOut(items=items)

    return router


def resident_bytes() -> int:
    """Resident memory of this process, from /proc."""
    with open("/proc/self/statm") as file:  # noqa: PTH123 - read at every scrape
        return int(file.read().split()[1]) * resource.getpagesize()


def _health(findings: list[Finding], response: Response) -> HealthOut:
    if failed(findings):
        response.status_code = HTTPStatus.SERVICE_UNAVAILABLE
    verdicts = [finding.verdict for finding in findings]
    worst = next((one for one in (Verdict.FAILED, Verdict.WARNING) if one in verdicts), Verdict.OK)
    response.headers["Cache-Control"] = "no-store"
    checks = [FindingOut(name=one.name, verdict=one.verdict, finding=one.finding) for one in findings]
    return HealthOut(status=worst, checks=checks)
