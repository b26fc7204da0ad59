"""Tokens over HTTP: every route needs its scope, and what a token has opened ends with it."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import APIRouter
from spiked_service.api.app import create_app
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.base.health import Health
from spiked_service.daemon import build_services, open_data_store
from spiked_service.events.bus import Bus
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.tokens import Scope, Tokens
from starlette.testclient import TestClient
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from spiked.sensor import Sensor

from ..survival import random_recording

METHODS = ("get", "head", "post", "put", "patch", "delete")
ADMIN = {
    ("get", "/api/v1/configuration"),
    ("post", "/api/v1/configuration:reload"),
    ("patch", "/api/v1/configuration"),
    ("get", "/api/v1/tokens"),
    ("post", "/api/v1/tokens"),
    ("delete", "/api/v1/tokens/{name}"),
}
LOOKING = {
    ("post", "/api/v1/captures/{capture_id}/views"),
    ("post", "/api/v1/reconstructions/{reconstruction_id}/views"),
}
OPEN = {"/healthz", "/readyz"}
UNDESCRIBED = [("get", "/openapi.json"), ("get", "/docs/"), ("get", "/api/v1/events?topics=none"), ("get", "/")]


class Guarded:
    """The whole application where everybody needs a token, and one of each scope."""

    def __init__(self, folder: Path) -> None:
        tokens = Tokens(folder)
        self.secrets = {scope: tokens.create(scope, scope=scope) for scope in Scope}
        bus = Bus()
        self.data_store = open_data_store(folder, BusNotifier(bus))
        settings = ReloadableSettings({"require_token": True})
        self.app = create_app(build_services(settings, tokens, self.data_store, bus, Health()))
        self.http = TestClient(self.app, base_url="http://127.0.0.1:8650", follow_redirects=False)

    def status(self, method: str, path: str, scope: Scope | None) -> int:
        headers = {} if scope is None else {"authorization": f"Bearer {self.secrets[scope]}"}
        return self.http.request(method, path, headers=headers).status_code


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    one = Guarded(tmp_path_factory.mktemp("guarded"))
    yield one
    one.data_store.close()


def needed(method: str, path: str) -> Scope:
    """What the operations need: listed here once more, so that a change of the code shows."""
    if (method, path) in ADMIN:
        return Scope.ADMIN
    return Scope.READ if method in ("get", "head") or (method, path) in LOOKING else Scope.OPERATE


def operations(guarded: Guarded) -> list[tuple[str, str, dict[str, Any]]]:
    paths = guarded.app.openapi()["paths"].items()
    return [(method, path, methods[method]) for path, methods in paths for method in METHODS if method in methods]


def test_every_operation_says_and_demands_its_scope(guarded: Guarded) -> None:
    found = operations(guarded)
    assert len(found) > 40 and {(method, path) for method, path, _ in found} >= ADMIN | LOOKING
    for method, path, operation in found:
        if path in OPEN:
            assert operation["security"] == [{}]
            assert guarded.status(method, path, None) in (200, 503)
            continue
        scope = needed(method, path)
        assert operation["security"] == [{}, {"token": [scope]}], (method, path)
        assert f"Scope of a token: `{scope}`." in operation["description"]
        assert "403" in operation["responses"] or path == "/metrics"
        address = path.replace("{", "").replace("}", "")
        assert guarded.status(method, address, None) == 401
        for brought in Scope:
            status = guarded.status(method, address, brought)
            assert (status == 403) == (not brought.allows(scope)), (method, path, brought, status)
            assert status != 401


def test_a_client_learns_what_its_token_allows(guarded: Guarded) -> None:
    for scope, secret in guarded.secrets.items():
        answer = guarded.http.get("/api/v1/system", headers={"authorization": f"Bearer {secret}"})
        assert answer.json()["scope"] == scope


def test_no_route_is_left_out(guarded: Guarded) -> None:
    """Whatever a route declares: without a token nothing opens, and one to read with changes nothing."""
    seen = 0
    for route in routes(guarded.app.router):
        for method in sorted(route.methods or ["GET"]):
            path = route.path_format.replace("{", "").replace("}", "")
            if path in OPEN:
                continue
            seen += 1
            assert guarded.status(method, path, None) == 401, (method, path)
            if path.startswith("/api/v1/attempts/"):  # they take the token of an attempt and no other
                assert {guarded.status(method, path, scope) for scope in Scope} == {410}
                continue
            if method not in ("GET", "HEAD") and (method.lower(), route.path_format) not in LOOKING:
                assert guarded.status(method, path, Scope.READ) == 403, (method, path)
    assert seen > 40
    for method, path in UNDESCRIBED:
        assert guarded.status(method, path, None) == 401
        assert guarded.status(method, path, Scope.READ) not in (401, 403)


def routes(router: APIRouter) -> Iterator[Any]:
    """All routes of the application with their whole paths, however FastAPI nests them."""
    from fastapi.routing import iter_route_contexts

    for route in iter_route_contexts(router.routes):
        if hasattr(route, "methods") and route.path_format:
            yield route


@pytest.mark.parametrize("path", ["/api/v1/tokens\n", "/api/v1/tokens/", "/api/v1//tokens", "/API/v1/tokens"])
def test_odd_addresses_are_no_way_around(guarded: Guarded, path: str) -> None:
    answer = guarded.http.get(
        path.replace("\n", "%0A"), headers={"authorization": f"Bearer {guarded.secrets[Scope.READ]}"}
    )
    assert answer.status_code in (307, 403, 404) and "created_at" not in answer.text


def test_an_answer_is_not_given_again_to_who_may_not_ask(guarded: Guarded) -> None:
    def start_upload(scope: Scope) -> httpx.Response:
        headers = {"authorization": f"Bearer {guarded.secrets[scope]}", "idempotency-key": "once"}
        return guarded.http.post("/api/v1/uploads", json={"name": "a.dat", "bytes": 1000}, headers=headers)

    assert start_upload(Scope.OPERATE).status_code == 201
    refused = start_upload(Scope.READ)
    assert refused.status_code == 403
    assert "spiked token create NAME --scope operate" in refused.json()["detail"]


@pytest.fixture
def opened(daemon: Callable[..., Any], tmp_path: Path) -> tuple[Any, Tokens, str]:
    """A daemon that wants tokens, its tokens, and one to be revoked."""
    tokens = Tokens(tmp_path / "data")
    keeper, guest = tokens.create("keeper"), tokens.create("guest", scope=Scope.READ)
    one = daemon("--set", "require_token=true", "--no-capture", token=keeper)
    return one, tokens, guest


def test_a_revoked_token_ends_its_websockets_only(opened: tuple[Any, Tokens, str]) -> None:
    one, tokens, guest = opened
    address = one.address.replace("http", "ws") + "api/v1/events"
    keeper = {"Authorization": one.http.headers["authorization"]}
    with (
        connect(address, additional_headers={"Authorization": f"Bearer {guest}"}) as theirs,
        connect(address, additional_headers=keeper) as ours,
    ):
        tokens.revoke("guest")
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                theirs.recv(timeout=30)
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, "revoked" in closed.value.rcvd.reason) == (1008, True)
        one.http.post("captures", json={"source": "sim:?width=96&height=64", "frames": 64, "reconstruct": False})
        assert json.loads(ours.recv(timeout=30))["topic"]


def test_a_revoked_token_ends_server_sent_events(opened: tuple[Any, Tokens, str]) -> None:
    one, tokens, guest = opened
    headers = {"Authorization": f"Bearer {guest}"}
    with httpx.stream("GET", f"{one.address}api/v1/events", headers=headers, timeout=60) as answer:
        lines = answer.iter_lines()
        assert next(lines) == ": spiked events"
        tokens.revoke("guest")
        with pytest.raises(httpx.RemoteProtocolError):
            list(lines)


def test_a_revoked_token_ends_its_downloads(opened: tuple[Any, Tokens, str], tmp_path: Path) -> None:
    one, tokens, guest = opened
    random_recording(tmp_path / "noise.dat", 40, Sensor(1000, 1000, 20_000.0))
    source = f"replay:{tmp_path / 'noise.dat'}?pace=0&repeat=10"
    started = one.http.post("captures", json={"source": source, "reconstruct": False})
    url = f"captures/{started.json()['id']}"
    while one.http.get(url).json()["state"] not in ("complete", "failed"):
        pass
    size = one.http.get(url).json()["recording"]["bytes"]
    assert size == 400 * 125_000  # more than the sockets hold, so that it is on its way when the token ends
    theirs = {"Authorization": f"Bearer {guest}"}
    ours = {"Authorization": one.http.headers["authorization"]}
    with (
        httpx.stream("GET", f"{one.address}api/v1/events?topics=log", headers=ours, timeout=60) as log,
        httpx.stream("GET", f"{one.address}api/v1/{url}/recording", headers=theirs, timeout=60) as answer,
    ):
        pieces = answer.iter_raw()
        come = len(next(pieces))
        tokens.revoke("guest")
        assert any("stream ended" in line and "guest" in line for line in log.iter_lines())
        with pytest.raises(httpx.RemoteProtocolError):
            for piece in pieces:
                come += len(piece)
    assert come < size
