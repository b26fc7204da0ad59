"""What a request must pass: name of the host, origin, token, length, rate."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request
from spiked_service.api.auth.security import HEADERS, Security
from spiked_service.api.auth.wrong_tokens import WrongTokens
from spiked_service.api.problems import install
from spiked_service.base.limits import ConcurrencyLimit, OverloadedError, RateLimit
from spiked_service.daemon import check_access
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.tokens import Tokens
from starlette.testclient import TestClient
from structlog.testing import capture_logs

from spiked.errors import ConfigurationError


@pytest.fixture(autouse=True)
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in os.environ if name.startswith("SPIKED_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def client(tmp_path: Path, **settings: object) -> TestClient:
    """A service that tells how long a body was, behind the real middleware."""
    app = FastAPI()
    install(app)

    @app.post("/api/v1/length")
    @app.patch("/api/v1/uploads/x")
    async def length(request: Request) -> int:
        return len(await request.body())

    @app.get("/")
    @app.get("/healthz")
    @app.get("/api/v1/system")
    async def system(request: Request) -> Any:
        return request.state.caller.name

    live = ReloadableSettings(settings)
    app.add_middleware(Security, settings=live, tokens=Tokens(tmp_path))
    return TestClient(app, base_url="http://127.0.0.1:8650", client=("10.0.0.9", 5))


def problem(answer: httpx.Response, status: int) -> str:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return str(answer.json()["detail"])


def test_every_answer_bears_the_headers(tmp_path: Path) -> None:
    http = client(tmp_path)
    for answer in (http.get("/api/v1/system"), http.get("/nowhere"), http.get("/", headers={"host": "evil.example"})):
        assert {name: answer.headers[name] for name in HEADERS} == HEADERS
        assert "access-control-allow-origin" not in answer.headers
        assert "unsafe-inline" not in answer.headers["content-security-policy"]


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8650", "localhost", "[::1]:8650", "192.168.1.7", "camera.lab:80", "a.localhost"]
)
def test_hosts_that_cannot_be_somebody_elses_name(tmp_path: Path, host: str) -> None:
    assert client(tmp_path, allowed_hosts="camera.lab").get("/", headers={"host": host}).status_code == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "a@localhost", "", "[", ":80"]
)
def test_a_rebound_name_is_refused(tmp_path: Path, host: str) -> None:
    assert "allowed_hosts" in problem(client(tmp_path).get("/", headers={"host": host}), 421)


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
def test_pages_of_other_sites_change_nothing(tmp_path: Path, headers: dict[str, str]) -> None:
    http = client(tmp_path)
    problem(http.post("/api/v1/length", headers=headers), 403)
    assert http.post("/api/v1/length", headers={"origin": "http://127.0.0.1:8650"}).status_code == 200
    assert http.get("/", headers=headers).status_code == 200


def test_a_token_opens_as_header_cookie_or_form_until_it_is_revoked(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    secret = tokens.create("laptop")
    http = client(tmp_path, require_token=True)
    assert http.get("/healthz").status_code == 200
    assert "spiked token" in problem(http.get("/api/v1/system"), 401)
    for wrong in (secret[:-1], secret + "x", secret.swapcase(), "Bearer", "ü"):
        assert http.get("/api/v1/system", headers={"authorization": f"Bearer {wrong}".encode()}).status_code == 401
    assert http.get("/api/v1/system", headers={"authorization": f"bearer {secret}"}).json() == "laptop"
    assert http.get(f"/api/v1/system?token={secret}").status_code == 401  # only where a browser can do no other

    asked = http.get("/?page=captures&token=old", headers={"accept": "text/html"})
    assert asked.status_code == 401 and "<form method=post action='/sign-in?then=page%3Dcaptures'>" in asked.text
    assert "unsafe" not in asked.headers["content-security-policy"]
    assert asked.headers["referrer-policy"] == "same-origin"  # with no-referrer a form is posted as `Origin: null`
    assert http.post("/sign-in", data={"token": "guess"}).status_code == 401
    for wanted, there in (
        ("page=captures", "/?page=captures"),
        ("", "/"),
        ("//evil.example", "/?//evil.example"),
        ("#x", "/"),
    ):
        opened = http.post("/sign-in", params={"then": wanted}, data={"token": secret}, follow_redirects=False)
        assert (opened.status_code, opened.headers["location"]) == (303, there)
    assert http.get("/sign-in", follow_redirects=False).headers["location"] == "/"  # gone back to, with the cookie
    cookie = opened.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie
    assert http.get("/api/v1/system").json() == "laptop"  # the client keeps the cookie
    tokens.revoke("laptop")
    assert http.get("/api/v1/system").status_code == 401


def test_a_token_in_the_address_moves_into_a_cookie(tmp_path: Path) -> None:
    secret = Tokens(tmp_path).create("laptop")
    http = client(tmp_path, require_token=True)
    moved = http.get(f"/?page=live&token={secret}", follow_redirects=False)
    assert (moved.status_code, moved.headers["location"]) == (303, "/?page=live")
    assert http.get("/").status_code == 200


def test_damaged_tokens_open_nothing(tmp_path: Path) -> None:
    (tmp_path / "tokens.json").write_text("[{}]")
    http = client(tmp_path, require_token=True)
    assert "tokens.json" in problem(http.get("/", headers={"authorization": "Bearer x"}), 503)
    assert http.get("/").status_code == 401


def test_a_body_that_is_too_long_is_refused_announced_or_not(tmp_path: Path) -> None:
    http = client(tmp_path, limit_body_bytes=2000)
    assert http.post("/api/v1/length", content=b"x" * 2000).json() == 2000
    assert "2000 bytes" in problem(http.post("/api/v1/length", content=b"x" * 2001), 413)

    def pieces() -> Iterator[bytes]:
        for _ in range(30):
            yield b"x" * 100

    assert "2000 bytes" in problem(http.post("/api/v1/length", content=pieces()), 413)
    problem(http.post("/api/v1/length", headers={"content-length": "-1"}), 413)
    assert http.patch("/api/v1/uploads/x", content=b"x" * 5000).json() == 5000


def test_who_asks_too_often_is_told_when_to_come_again(tmp_path: Path) -> None:
    http = client(tmp_path, limit_requests_per_s=0.5, limit_requests_burst=3)
    assert [http.get("/").status_code for _ in range(4)] == [200, 200, 200, 429]
    answer = http.get("/")
    problem(answer, 429)
    assert answer.headers["retry-after"] == "2"


def test_the_bucket_fills_again_and_callers_have_their_own() -> None:
    now_s = 0.0
    limit = RateLimit(rate=2.0, burst=2, clock=lambda: now_s)
    assert [limit.wait_s("a") for _ in range(3)] == [0, 0, 0.5]
    assert limit.wait_s("b") == 0
    now_s = 0.5
    assert [limit.wait_s("a") for _ in range(2)] == [0, 0.5]
    for number in range(10_000):
        limit.wait_s(str(number))
    assert limit.callers == 4096


def test_a_gate_lets_so_many_in() -> None:
    concurrency = ConcurrencyLimit("renders", 1)
    with concurrency():
        with pytest.raises(OverloadedError, match="1 renders at a time"):
            concurrency.acquire()
        concurrency.limit = 2
        with concurrency():
            assert concurrency.active == 2
    assert (concurrency.active, concurrency.rejected) == (0, 1)


def test_beyond_loopback_or_where_asked_for_there_must_be_a_token(tmp_path: Path) -> None:
    for settings in ({"host": "0.0.0.0"}, {"require_token": True}):
        now = ReloadableSettings(settings).now
        with pytest.raises(ConfigurationError, match="spiked token create"):
            check_access(now, Tokens(tmp_path))
        check_access(now, Tokens(tmp_path, "from the settings"))
    check_access(ReloadableSettings({"host": "::1"}).now, Tokens(tmp_path))


def guess(http: TestClient, token: str) -> httpx.Response:
    return http.get("/api/v1/system", headers={"authorization": f"Bearer {token}"})


def test_who_guesses_tokens_waits_and_is_logged(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    known, new = tokens.create("known"), tokens.create("new")
    http = client(tmp_path, require_token=True)
    assert guess(http, known).status_code == 200
    with capture_logs() as lines:
        assert [guess(http, f"guess {number}").status_code for number in range(11)] == [401] * 11
        told = guess(http, "guess 11")
    assert "wrong tokens from 10.0.0.9" in problem(told, 429)
    assert told.headers["retry-after"] == "1"
    assert guess(http, new).status_code == 429  # even the right one: a guess that is right tells nothing
    form = http.post("/sign-in", data={"token": new})
    assert form.status_code == 429 and "wait 1 seconds" in form.text
    assert guess(http, known).status_code == 200  # nobody is locked out by a neighbour
    assert guess(http, "guess 3").status_code == 401  # the same mistake again is no guess
    assert http.get("/healthz", headers={"authorization": "Bearer x"}).status_code == 200
    (line,) = (line for line in lines if line["event"] == "wrong token")  # the next line has those of ten seconds
    assert line["address"] == "10.0.0.9" and line["count"] == 1


def test_the_wait_doubles_up_to_a_minute_and_is_forgotten() -> None:
    now_s = 0.0
    wrong = WrongTokens(clock=lambda: now_s)
    waits = []
    for number in range(20):
        while wait_s := wrong.wait_s("10.0.0.9", f"guess {number}", right=False):
            waits.append(wait_s)
            now_s += wait_s
    assert waits == [1, 2, 4, 8, 16, 32, 60, 60, 60]
    assert wrong.wait_s("10.0.0.10", "guess", right=False) == 0
    now_s += 1000
    assert [wrong.wait_s("10.0.0.9", f"later {number}", right=False) for number in range(11)] == [0] * 11
    for number in range(11):
        wrong.wait_s(f"2001:db8::{number:x}", f"guess {number}", right=False)
    assert wrong.wait_s("2001:db8::ffff", "guess", right=True) > 0  # who has one address of a network has them all
    for number in range(5000):
        wrong.wait_s(f"10.1.{number // 256}.{number % 256}", "guess", right=False)
    assert wrong.callers == 4096
