"""Tokens: made, listed, expired, revoked, and how they lie on the disk."""

import stat
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import pytest
from spiked_service.tokens import Tokens

from spiked.errors import ConfigurationError


def test_only_a_hash_is_kept_and_only_the_owner_reads_it(tmp_path: Path) -> None:
    secret = Tokens(tmp_path).create("laptop")
    file = tmp_path / "tokens.json"
    assert secret not in file.read_text()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert len(secret) > 40
    assert Tokens(tmp_path).name_of(secret) == "laptop"


def test_a_running_service_sees_changes_at_once(tmp_path: Path) -> None:
    service, command = Tokens(tmp_path), Tokens(tmp_path)
    secret = command.create("laptop")
    assert service.name_of(secret) == "laptop"
    command.revoke("laptop")
    assert service.name_of(secret) is None
    assert not service.some()


def test_a_token_expires(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    assert tokens.name_of(tokens.create("old", timedelta(days=-1))) is None
    assert tokens.name_of(tokens.create("new", timedelta(days=1))) == "new"


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
    assert tokens.name_of("sesame") == "settings"
    assert tokens.name_of("sesam") is None


def test_the_command_makes_lists_and_revokes(tmp_path: Path) -> None:
    def spiked(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "spiked_service", "token", *words, "--data", str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    made = spiked("create", "laptop", "--days", "3")
    assert Tokens(tmp_path).name_of(made.stdout.strip()) == "laptop"
    listed = spiked("list").stdout
    assert listed.startswith("laptop  made ") and made.stdout.strip() not in listed
    assert spiked("revoke", "laptop").returncode == 0
    again = spiked("revoke", "laptop")
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
