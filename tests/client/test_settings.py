"""`Spiked` with the settings and tokens of a real service."""

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from spiked_service.settings.tokens import Scope as TokenScope
from spiked_service.settings.tokens import Tokens

from spiked.client import ApiError, Scope, Spiked


@pytest.fixture
def service(daemon: Callable[..., Any], tmp_path: Path) -> tuple[str, str]:
    """The address of a service that everybody needs a token for, and a token of scope `admin`."""
    (tmp_path / "data").mkdir()
    secret = Tokens(tmp_path / "data").create("admin", scope=TokenScope.ADMIN)
    (tmp_path / "spiked.toml").write_text("require_token = true\nlimit_renders = 3\n")
    address = daemon("--no-capture", "--config", str(tmp_path / "spiked.toml"), token=secret).address
    return address, secret


@pytest.fixture
def admin(service: tuple[str, str]) -> Iterator[Spiked]:
    """A client with that token."""
    address, secret = service
    with Spiked(address, token=secret) as client:
        yield client


def value(client: Spiked, key: str) -> Any:
    return next(one.value for one in client.configuration().items if one.key == key)


def test_settings_are_read_and_changed(admin: Spiked, tmp_path: Path) -> None:
    assert value(admin, "limit_renders") == 3
    done = admin.change_configuration({"limit_renders": 5, "deleted_days": 2})
    assert sorted(done.changed) == ["deleted_days", "limit_renders"] and done.needs_restart == []
    assert (value(admin, "limit_renders"), value(admin, "deleted_days")) == (5, 2)
    assert "limit_renders = 5" in (tmp_path / "spiked.toml").read_text()
    default = next(one.option["default"] for one in admin.configuration().items if one.key == "limit_renders")
    assert admin.change_configuration({"limit_renders": None}).changed == ["limit_renders"]
    assert value(admin, "limit_renders") == default
    (tmp_path / "spiked.toml").write_text("require_token = true\nlimit_renders = 7\n")
    assert "limit_renders" in admin.reload_configuration().changed and value(admin, "limit_renders") == 7
    with pytest.raises(ApiError, match="limit_renders"):
        admin.change_configuration({"limit_renders": -1})


def test_tokens_are_made_used_and_revoked(service: tuple[str, str], admin: Spiked) -> None:
    made = admin.create_token("display", days=90)
    assert (made.name, made.scope, made.created_by) == ("display", Scope.read, "admin")
    assert made.expires_at is not None
    assert abs(made.expires_at - datetime.now(UTC) - timedelta(days=90)) < timedelta(minutes=1)
    assert [one.name for one in admin.tokens()] == ["admin", "display"]
    with Spiked(service[0], token=made.secret) as display:
        assert display.system().version
        with pytest.raises(ApiError) as refused:
            display.tokens()
        assert refused.value.status == 403
        admin.revoke_token("display")
        with pytest.raises(ApiError) as refused:
            display.system()
        assert refused.value.status == 401
    with pytest.raises(ApiError, match="there is no token display"):
        admin.revoke_token("display")
