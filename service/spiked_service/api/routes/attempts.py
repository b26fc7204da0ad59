"""`attempts/ID`: what agents on other machines ask and tell, each with the token of its attempt."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from starlette.exceptions import HTTPException

from spiked_service.cluster.cluster import Cluster
from spiked_service.cluster.messages import AttemptWork, Begin, Next, Report, ReportAnswer
from spiked_service.cluster.remote_worker import FencedError, RemoteWorker


def attempt_routes(cluster: Cluster | None) -> APIRouter:
    """Routes below `attempts`. They are between a service and its agents of one version, and not in the document."""
    router = APIRouter(prefix="/attempts/{attempt:id}", include_in_schema=False)

    def cluster_of(attempt: str, request: Request) -> Cluster:
        """The cluster, if the request brings the token of the attempt; checked before its body is looked at."""
        token = request.headers.get("authorization", "").partition(" ")[2].strip()
        if not token:
            raise HTTPException(HTTPStatus.UNAUTHORIZED, "this needs the token of the attempt")
        if cluster is None:
            raise FencedError("jobs run on the machine of this service only")
        cluster.check(attempt, token)
        return cluster

    Granted = Annotated[Cluster, Depends(cluster_of)]

    def worker_of(attempt: str, cluster: Granted) -> RemoteWorker:
        """The living attempt."""
        return cluster.worker(attempt)

    Worker = Annotated[RemoteWorker, Depends(worker_of)]

    @router.post(":begin")
    def begin_attempt(worker: Worker, body: Begin) -> AttemptWork:
        """Give the work to an agent."""
        return worker.begin(body)

    @router.post(":report")
    def report_attempt(worker: Worker, body: Report) -> ReportAnswer:
        """Renew the lease and take events."""
        return worker.report(body)

    @router.post(":end", status_code=HTTPStatus.NO_CONTENT)
    def end_attempt(attempt: str, cluster: Granted, body: Report) -> None:
        """The results are stored."""
        cluster.end(attempt, body.agent)

    @router.post(":next")
    def next_attempt(attempt: str, cluster: Granted, body: Report) -> Next | None:
        """Another attempt that waits, for an agent whose own has just ended."""
        return cluster.next_for(attempt, body.agent)

    return router
