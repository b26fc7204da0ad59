"""Tokens: made, listed, expired, revoked, and how they lie on the disk."""

import stat
import subprocess
import sys
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import typer
from spiked_service.cli.main import app
from spiked_service.settings.settings import Settings, load_settings
from spiked_service.settings.tokens import Holder, Scope, Tokens, token_of

from spiked.errors import ConfigurationError


def test_only_a_hash_is_kept_and_only_the_owner_reads_it(tmp_path: Path) -> None:
    secret = Tokens(tmp_path).create("laptop")
    file = tmp_path / "tokens.json"
    assert secret not in file.read_text()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert len(secret) > 40
    assert Tokens(tmp_path).holder_of(secret) == Holder("laptop", Scope.ADMIN)


def test_a_running_service_sees_changes_at_once(tmp_path: Path) -> None:
    service, command = Tokens(tmp_path), Tokens(tmp_path)
    secret = command.create("laptop")
    assert service.holder_of(secret) == Holder("laptop", Scope.ADMIN)
    command.revoke("laptop")
    assert service.holder_of(secret) is None
    assert not service.some()


def test_a_token_expires(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    assert tokens.holder_of(tokens.create("old", timedelta(days=-1))) is None
    assert tokens.holder_of(tokens.create("new", timedelta(days=1))) == Holder("new", Scope.ADMIN)


@pytest.mark.parametrize("name", ["", "a b", "../x", "x" * 65, "-x"])
def test_odd_names_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigurationError, match="cannot name a token"):
        Tokens(tmp_path).create(name)


def test_names_are_taken_once_and_must_be_there_to_be_revoked(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    tokens.create("laptop")
    with pytest.raises(ConfigurationError, match="already"):
        tokens.create("laptop")
    with pytest.raises(ConfigurationError, match="no token phone"):
        tokens.revoke("phone")
    assert [token.name for token in tokens.all()] == ["laptop"]


def test_a_token_from_the_settings_opens_too(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path, "sesame")
    assert tokens.some()
    assert tokens.holder_of("sesame") == Holder("settings", Scope.ADMIN)
    assert tokens.holder_of("sesam") is None


def test_the_command_makes_lists_and_revokes(tmp_path: Path) -> None:
    def spiked(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "spiked_service", "token", *words, "--data", str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    made = spiked("create", "laptop", "--days", "3")
    assert Tokens(tmp_path).holder_of(made.stdout.strip()) == Holder("laptop", Scope.ADMIN)
    listed = spiked("list").stdout
    assert listed.startswith("laptop  admin  created ") and made.stdout.strip() not in listed
    assert spiked("revoke", "laptop").returncode == 0
    again = spiked("revoke", "laptop")
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)


def test_a_token_is_for_something_and_one_of_an_older_release_for_everything(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    assert tokens.holder_of(tokens.create("display", scope=Scope.READ)) == Holder("display", Scope.READ)
    secret = tokens.create("old")
    file = tmp_path / "tokens.json"
    file.write_text(file.read_text().replace(',\n    "scope": "admin"', ""))
    assert "admin" not in file.read_text()
    assert Tokens(tmp_path).holder_of(secret) == Holder("old", Scope.ADMIN)
    assert [(one, [other for other in Scope if one.allows(other)]) for one in Scope] == [
        (Scope.READ, [Scope.READ]),
        (Scope.OPERATE, [Scope.READ, Scope.OPERATE]),
        (Scope.ADMIN, [Scope.READ, Scope.OPERATE, Scope.ADMIN]),
    ]


def test_the_settings_take_a_token_from_a_file_or_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "secret"
    file.write_text("sesame\n")
    assert token_of(load_settings({"token_file": file}).settings) == "sesame"
    monkeypatch.setenv("SPIKED_TOKEN_FILE", str(file))
    assert token_of(load_settings().settings) == "sesame"
    with pytest.raises(ConfigurationError, match="one of them"):
        token_of(load_settings({"token": "other"}).settings)
    monkeypatch.delenv("SPIKED_TOKEN_FILE")
    monkeypatch.setenv("SPIKED_TOKEN", "other")
    assert token_of(load_settings().settings) == "other"
    monkeypatch.delenv("SPIKED_TOKEN")
    for content in ("", " \n", "two words"):
        file.write_text(content)
        with pytest.raises(ConfigurationError, match="does not hold a token"):
            token_of(load_settings({"token_file": file}).settings)
    with pytest.raises(ConfigurationError, match="No such file"):
        token_of(load_settings({"token_file": tmp_path / "none"}).settings)


def test_every_option_with_a_token_has_a_file_and_the_environment_beside_it() -> None:
    """What a command is given as an argument, every user of the machine can see."""

    def options(command: Any) -> Iterator[set[str]]:
        yield {word for parameter in command.params for word in parameter.opts}
        for child in getattr(command, "commands", {}).values():
            yield from options(child)

    given = [words for words in options(typer.main.get_command(app)) if "--token" in words]
    assert given
    for words in given:
        assert "--token-file" in words
    assert {"token", "token_file"} <= set(Settings.model_fields)  # SPIKED_TOKEN, SPIKED_TOKEN_FILE
