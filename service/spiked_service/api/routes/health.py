"""Health checks and metrics, outside of the API's prefix."""

from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from spiked_service.base.health import CheckResult, CheckStatus, Health, failed
from spiked_service.operations.metrics import Metrics


class FindingOut(BaseModel):
    """Result of one check."""

    name: str = Field(examples=["disk"])
    verdict: CheckStatus
    finding: str = Field(examples=["53 GiB free"])


class HealthOut(BaseModel):
    """Health of the service."""

    status: CheckStatus = Field(description="The worst of the checks.")
    checks: list[FindingOut]


def health_routes(health: Health) -> APIRouter:
    """`/healthz` and `/readyz`, which need no token."""
    router = APIRouter(tags=["operations"])
    failing: dict[int | str, dict[str, Any]] = {503: {"model": HealthOut, "description": "A check has failed."}}

    @router.get("/healthz", responses=failing)
    def get_health(response: Response) -> HealthOut:
        """Liveness: if a check fails, the service must be restarted."""
        return _health(health.life(), response)

    @router.get("/readyz", responses=failing)
    def get_readiness(response: Response) -> HealthOut:
        """Readiness: whether captures can be started."""
        return _health(health.readiness(), response)

    return router


def metrics_routes(metrics: Metrics) -> APIRouter:
    """`/metrics`."""
    router = APIRouter(tags=["operations"])

    @router.get("/metrics", response_class=PlainTextResponse, responses={200: {"content": {"text/plain": {}}}})
    def get_metrics() -> Response:
        """Figures for Prometheus; docs/operations.md explains each."""
        return Response(metrics.exposition(), media_type=CONTENT_TYPE_LATEST)

    return router


def _health(results: list[CheckResult], response: Response) -> HealthOut:
    if failed(results):
        response.status_code = HTTPStatus.SERVICE_UNAVAILABLE
    verdicts = [finding.verdict for finding in results]
    worst = next((one for one in (CheckStatus.FAILED, CheckStatus.WARNING) if one in verdicts), CheckStatus.OK)
    response.headers["Cache-Control"] = "no-store"
    checks = [FindingOut(name=one.name, verdict=one.verdict, finding=one.finding) for one in results]
    return HealthOut(status=worst, checks=checks)
