"""The tokens that open the service: made once, shown once, kept as hashes."""

import fcntl
import hashlib
import hmac
import os
import re
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from spiked.errors import ConfigurationError
from spiked_service.settings.settings import Settings

_FILE = "tokens.json"
_OF_SETTINGS = "settings"
"""Name of the holder of the token of the settings, which is not stored."""
_PREFIX = "spiked_"
"""So that a scanner of repositories and logs recognises one."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


class Scope(StrEnum):
    """What a token may do; each includes those before it."""

    READ = "read"
    """Look at everything that is captured, and take it away."""
    OPERATE = "operate"
    """Start, change and remove captures, reconstructions and uploads."""
    ADMIN = "admin"
    """See and change how the service is set up."""

    def allows(self, needed: "Scope") -> bool:
        """Whether it includes the other."""
        return _SCOPES.index(self) >= _SCOPES.index(needed)


_SCOPES = list(Scope)


@dataclass(frozen=True)
class Holder:
    """Who brings a token, and what it opens."""

    name: str
    scope: Scope


class StoredToken(BaseModel):
    """What is kept of a token. It has 256 random bits, so a plain hash says nothing about it."""

    model_config = ConfigDict(frozen=True)

    name: str
    sha256: str
    created_at: datetime
    expires_at: datetime | None = None
    scope: Scope = Scope.ADMIN
    """Tokens of older releases opened everything."""
    created_by: str | None = None
    """The token that a request created it with; None: the command line."""

    def expired(self, now: datetime) -> bool:
        """Whether it no longer opens anything."""
        return self.expires_at is not None and self.expires_at <= now


_tokens = TypeAdapter(list[StoredToken])


class Tokens:
    """The tokens below a data folder, readable by their owner only. Changes of the file show at the next look at it."""

    def __init__(self, folder: Path, extra: str | None = None) -> None:
        """`extra` is a token from the settings, which opens the service too."""
        self._path = folder / _FILE
        self._extra = None if extra is None else _hash(extra)
        self._lock = threading.Lock()
        self._seen: tuple[int, int, int] | None = None
        self._known: list[StoredToken] = []

    def all(self) -> list[StoredToken]:
        """Oldest first. Raises ConfigurationError if the file is damaged."""
        with self._lock:
            self._reload_if_changed()
            return list(self._known)

    def some(self) -> bool:
        """Whether there is any token at all."""
        return self._extra is not None or bool(self.all())

    def holder_of(self, given: str) -> Holder | None:
        """Who brings this token; None if nobody may. Takes as long for a wrong token as for a right one."""
        digest, found, now = _hash(given), None, datetime.now(UTC)
        for token in self.all():
            if hmac.compare_digest(token.sha256, digest) and not token.expired(now):
                found = Holder(token.name, token.scope)
        if self._extra is not None and hmac.compare_digest(self._extra, digest):
            found = found or Holder(_OF_SETTINGS, Scope.ADMIN)
        return found

    def create(
        self, name: str, lifetime: timedelta | None = None, scope: Scope = Scope.ADMIN, by: str | None = None
    ) -> str:
        """A new token; this is the only time that it is seen. Raises ConfigurationError for a name that is taken.

        One that is created `by` another token ends no later than that one. Raises ConfigurationError, too, if that was
        revoked or has expired since it was asked for its name.
        """
        if not _NAME.fullmatch(name):
            raise ConfigurationError(f"{name!r} cannot name a token: use letters, digits, '.', '-' and '_'")
        secret = _PREFIX + secrets.token_urlsafe(32)
        now = datetime.now(UTC).replace(microsecond=0)
        with self._changing() as tokens:
            if any(token.name == name for token in tokens):
                raise ConfigurationError(f"there is a token {name} already; revoke it first, or take another name")
            ends = [] if lifetime is None else [now + lifetime]
            ends += self._end_of(by, tokens, now)
            until = min(ends, default=None)
            tokens.append(
                StoredToken(
                    name=name, sha256=_hash(secret), created_at=now, expires_at=until, scope=scope, created_by=by
                )
            )
        return secret

    def _end_of(self, by: str | None, tokens: list[StoredToken], now: datetime) -> list[datetime]:
        """When the token ends with which another one is created; empty: never."""
        if by is None:
            return []
        makers = [token for token in tokens if token.name == by and not token.expired(now)]
        if not makers and not (by == _OF_SETTINGS and self._extra is not None):
            raise ConfigurationError(f"the token {by}, which this is asked for with, is not valid any more")
        return [token.expires_at for token in makers if token.expires_at is not None]

    def revoke(self, name: str) -> None:
        """A running service refuses it from its next request on. Raises ConfigurationError if there is none."""
        with self._changing() as tokens:
            kept = [token for token in tokens if token.name != name]
            if len(kept) == len(tokens):
                raise ConfigurationError(f"there is no token {name}; `spiked token list` shows those there are")
            tokens[:] = kept

    @contextmanager
    def _changing(self) -> Iterator[list[StoredToken]]:
        """The list to change; one process at a time, and the file is whole at any moment."""
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with self._path.with_suffix(".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                tokens = self.all()
                yield tokens
                new = self._path.with_suffix(".new")
                with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
                    file.write(_tokens.dump_json(tokens, indent=2))
                    file.flush()
                    os.fsync(file.fileno())
                new.replace(self._path)
        except OSError as error:
            raise ConfigurationError(f"cannot keep tokens in {self._path}: {error.strerror}") from error

    def _reload_if_changed(self) -> None:
        try:
            stat = self._path.stat()
        except FileNotFoundError:
            self._seen, self._known = None, []
            return
        seen = (stat.st_mtime_ns, stat.st_ino, stat.st_size)
        if seen == self._seen:
            return
        try:
            self._known = _tokens.validate_json(self._path.read_bytes())
        except (OSError, ValidationError) as error:
            raise ConfigurationError(f"{self._path} is damaged: remove it and create new tokens") from error
        self._seen = seen


def token_of(settings: Settings) -> str | None:
    """The token of the settings, given there or in a file that they name. Raises ConfigurationError."""
    return chosen_token(settings.token.get_secret_value() if settings.token else None, settings.token_file)


def chosen_token(token: str | None, file: Path | None) -> str | None:
    """A token that is given itself or in a file; None if neither is. Raises ConfigurationError."""
    if file is None:
        return token
    if token is not None:
        raise ConfigurationError("token and token_file both say what opens the service: give one of them")
    try:
        found = file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot read the token in {file}: {error}") from error
    if not found or len(found.split()) > 1:
        raise ConfigurationError(f"{file} does not hold a token: write it into the file, on one line")
    return found


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode(errors="surrogatepass")).hexdigest()
