"""Settings and tokens that are changed over HTTP: what is written, what is refused, and who may."""

import json
import os
import stat
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from spiked_service.settings.editing import EDITABLE, edited
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.settings.settings import Settings, pass_on
from spiked_service.settings.tokens import Scope, Tokens

from spiked.errors import ConfigurationError
from spiked.whole_files import whole_file

FILE = """# of the laboratory
limit_renders = 3  # the GPU is shared
webhooks = [
    "http://127.0.0.1:9/a",  # nobody
]

deleted_days = 2
"""
GUARDED = {
    "data",
    "runtime",
    "devices",
    "host",
    "port",
    "allowed_hosts",
    "source_folders",
    "webhooks",
    "zmq",
    "zmq_port",
    "token",
    "token_file",
    "require_token",
    "tls_certificate",
    "tls_key",
    "executor",
    "executor_address",
    "executor_store",
    "executor_url",
    "executor_cpus",
    "executor_gpus",
    "executor_lease_s",
    "executor_cache_bytes",
    "executor_options",
}
"""Who may use the service, where it listens, what it reaches, and where its jobs run."""


def test_every_setting_is_either_guarded_or_editable() -> None:
    assert not GUARDED & EDITABLE
    assert set(Settings.model_fields) == GUARDED | EDITABLE


def changed(one: Any, **values: Any) -> httpx.Response:
    answer: httpx.Response = one.http.patch("configuration", json={"values": values})
    return answer


def shown(one: Any, key: str) -> dict[str, Any]:
    items = one.http.get("configuration").json()["items"]
    return next(item for item in items if item["key"] == key)


def test_settings_are_changed_in_their_file(daemon: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "spiked.toml"
    file.write_text(FILE)
    file.chmod(0o640)
    one = daemon("--config", str(file), "--no-capture")
    assert one.http.get("configuration").json()["file"] == str(file)
    answer = changed(one, limit_renders=5, retention_days=30.5, log_format="json", deleted_days=None)
    assert answer.status_code == 200, answer.text
    assert answer.json() == {
        "changed": ["limit_renders", "retention_days", "deleted_days"],
        "needs_restart": ["log_format"],
    }
    assert file.read_text() == (
        FILE.replace("limit_renders = 3", "limit_renders = 5").replace("deleted_days = 2\n", "")
        + 'retention_days = 30.5\nlog_format = "json"\n'
    )
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert (shown(one, "limit_renders")["value"], shown(one, "deleted_days")["value"]) == (5, 7.0)
    assert shown(one, "log_format")["value"] == "auto"
    assert one.http.get("configuration").json()["needs_restart"] == ["log_format"]
    one.close()
    again = daemon("--config", str(file), "--no-capture")
    assert shown(again, "log_format")["value"] == "json"
    assert again.http.get("configuration").json()["needs_restart"] == []


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"limit_renders": 0}, "limit_renders in {file}: input should be greater than or equal to 1"),
        ({"limit_renders": 7, "log_level": "lowd"}, "log_level in {file}"),
        ({"limit_render": 7}, "there is no setting limit_render"),
        ({"source_folders": "/"}, "on the machine of the service"),
        ({"require_token": False}, "on the machine of the service"),
        ({"retention_days": 3}, "--set is not"),
        ({"limit_captures": 3}, "SPIKED_LIMIT_CAPTURES is set"),
    ],
)
def test_a_refused_change_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, values: dict[str, Any], told: str
) -> None:
    file = tmp_path / "spiked.toml"
    file.write_text(FILE)
    monkeypatch.setenv("SPIKED_LIMIT_CAPTURES", "2")
    settings = ReloadableSettings({"retention_days": "9"}, file)
    before = settings.now
    with pytest.raises(ConfigurationError) as refused:
        settings.change(values)
    expected = told.format(file=file) if told != "--set is not" else "retention_days is given by --set"
    assert expected in str(refused.value)
    assert (file.read_text(), settings.now) == (FILE, before)
    assert [path.name for path in tmp_path.iterdir()] == ["spiked.toml"]


def test_what_listeners_refuse_is_put_back(tmp_path: Path) -> None:
    file = tmp_path / "spiked.toml"
    file.write_text(FILE)
    settings = ReloadableSettings({}, file)

    def refuse(now: Settings) -> None:
        if now.limit_renders == 4:
            raise ConfigurationError("four are not possible")

    settings.on_change(refuse)
    with pytest.raises(ConfigurationError, match="four"):
        settings.change({"limit_renders": 4})
    assert (file.read_text(), settings.now.limit_renders) == (FILE, 3)


def test_without_a_file_that_of_the_user_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("SPIKED_CONFIG", raising=False)
    settings = ReloadableSettings()
    assert settings.change({"limit_renders": 4}).changed == ["limit_renders"]
    assert (tmp_path / "config" / "spiked" / "spiked.toml").read_text() == "limit_renders = 4\n"
    assert ReloadableSettings().now.limit_renders == 4


def test_a_file_that_lines_do_not_tell_is_left_alone() -> None:
    with pytest.raises(ConfigurationError, match="with an editor"):
        edited('webhooks = ["""\nlimit_renders = 3\n"""]\n', {"limit_renders": 4})


class Three:
    """A daemon that wants tokens, and one client for each scope."""

    def __init__(self, one: Any, tokens: Tokens) -> None:
        self.one, self.tokens = one, tokens

    def http(self, scope: Scope) -> httpx.Client:
        secret = self.tokens.create(f"{scope}-{len(self.tokens.all())}", scope=scope)
        return httpx.Client(base_url=self.one.http.base_url, headers={"Authorization": f"Bearer {secret}"})


@pytest.fixture
def three(daemon: Callable[..., Any], tmp_path: Path) -> Three:
    tokens = Tokens(tmp_path / "data")
    file = tmp_path / "spiked.toml"
    file.write_text("require_token = true\n")
    return Three(daemon("--config", str(file), "--no-capture", token=tokens.create("keeper")), tokens)


def test_tokens_are_made_shown_once_and_revoked(three: Three) -> None:
    admin = three.http(Scope.ADMIN)
    answer = admin.post("tokens", json={"name": "display", "scope": "read", "days": 1})
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    made = answer.json()
    assert (made["scope"], made["created_by"]) == ("read", "admin-1")
    guest = httpx.Client(base_url=admin.base_url, headers={"Authorization": f"Bearer {made['secret']}"})
    system = guest.get("system").json()
    assert (system["scope"], system["token_scope"], system["token_required"]) == ("read", "read", True)
    listed = admin.get("tokens")
    assert "display" in [one["name"] for one in listed.json()["items"]]
    assert made["secret"] not in listed.text and "sha256" not in listed.text
    assert admin.post("tokens", json={"name": "display", "scope": "read"}).status_code == 422
    assert admin.delete("tokens/display").status_code == 204
    assert admin.delete("tokens/display").status_code == 404
    assert guest.get("system").status_code == 401


@pytest.mark.parametrize("scope", [Scope.READ, Scope.OPERATE])
def test_lesser_scopes_neither_make_nor_revoke(three: Three, scope: Scope) -> None:
    http = three.http(scope)
    before = three.tokens.all()
    assert http.post("tokens", json={"name": "mine", "scope": "read"}).status_code == 403
    assert http.delete("tokens/keeper").status_code == 403
    assert http.patch("configuration", json={"values": {"limit_renders": 2}}).status_code == 403
    assert three.tokens.all() == before


def test_a_token_ends_no_later_than_the_one_it_was_made_with(three: Three) -> None:
    admin = three.http(Scope.ADMIN)
    first = admin.post("tokens", json={"name": "week", "scope": "admin", "days": 7}).json()
    week = httpx.Client(base_url=admin.base_url, headers={"Authorization": f"Bearer {first['secret']}"})
    for name, days in (("for-ever", None), ("a-year", 365)):
        made = week.post("tokens", json={"name": name, "scope": "admin", "days": days}).json()
        assert made["expires_at"] == first["expires_at"]
    assert (
        week.post("tokens", json={"name": "a-day", "scope": "read", "days": 1}).json()["expires_at"]
        < (first["expires_at"])
    )


def test_a_token_that_was_revoked_meanwhile_makes_none(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    tokens.create("week", timedelta(days=7))
    tokens.revoke("week")
    with pytest.raises(ConfigurationError, match="week, which this is asked for with, is not valid any more"):
        tokens.create("for-ever", by="week")
    tokens.create("ended", timedelta(days=-1))
    with pytest.raises(ConfigurationError, match="not valid any more"):
        tokens.create("for-ever", by="ended")
    with pytest.raises(ConfigurationError, match="not valid any more"):
        tokens.create("for-ever", by="settings")
    assert Tokens(tmp_path, "the token of the settings").create("made", by="settings")
    assert [token.name for token in tokens.all()] == ["ended", "made"]


def test_without_a_token_nobody_makes_one_even_on_loopback(daemon: Callable[..., Any], tmp_path: Path) -> None:
    tokens = Tokens(tmp_path / "data")
    reader, admin = tokens.create("reader", scope=Scope.READ), tokens.create("admin")
    one = daemon("--no-capture")
    body = {"name": "mine", "scope": "admin"}
    for headers in ({}, {"Authorization": f"Bearer {reader}"}):
        answer = one.http.post("tokens", json=body, headers=headers)
        assert answer.status_code == 403 and "spiked token create" in answer.json()["detail"]
        assert one.http.delete("tokens/admin", headers=headers).status_code == 403
    assert one.http.post("tokens", json=body, headers={"Authorization": f"Bearer {admin}"}).status_code == 201


def test_changes_are_logged_with_who_made_them_at_any_level(three: Three) -> None:
    admin = three.http(Scope.ADMIN)
    assert admin.patch("configuration", json={"values": {"log_level": "error"}}).status_code == 200
    headers = {"Authorization": admin.headers["authorization"]}
    with httpx.stream("GET", f"{three.one.address}api/v1/events?topics=log", headers=headers, timeout=60) as answer:
        lines = answer.iter_lines()
        next(lines)
        admin.post("tokens", json={"name": "display", "scope": "read"})
        told = next(line for line in lines if "token created" in line)
    data = json.loads(told.removeprefix("data: "))["data"]
    assert (data["token"], data["caller"]) == ("display", "admin-1")


def test_what_is_passed_on_to_workers_is_no_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spiked_service.settings.settings._PASSED_ON", set())
    monkeypatch.delenv("SPIKED_RENDER", raising=False)
    file = tmp_path / "spiked.toml"
    file.write_text('render = "cpu"\n')
    settings = ReloadableSettings({}, file)
    monkeypatch.setenv("SPIKED_RENDER", "")  # so that what is passed on is taken back after this test
    monkeypatch.delenv("SPIKED_RENDER")
    pass_on(settings.now)
    assert os.environ["SPIKED_RENDER"] == "cpu"
    assert settings.change({"render": "cuda"}).waiting == ["render"]
    assert 'render = "cuda"' in file.read_text()


def test_the_file_is_never_wider_than_it_was(tmp_path: Path) -> None:
    file = tmp_path / "spiked.toml"
    file.write_text('token = "secret of the laboratory"\n')
    file.chmod(0o600)
    with whole_file(file) as part:
        assert stat.S_IMODE(part.stat().st_mode) == 0o600
        part.write_text("")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
