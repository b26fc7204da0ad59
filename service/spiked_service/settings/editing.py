"""Settings that are changed over the API: which ones, and how the file is changed."""

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked.whole_files import whole_file
from spiked_service.settings.settings import SettingOrigin, Settings, flag_of, load_settings, own_file

EDITABLE = frozenset(
    {
        "log_level",
        "log_format",
        "limit_body_bytes",
        "limit_chunk_bytes",
        "limit_upload_bytes",
        "limit_requests_per_s",
        "limit_requests_burst",
        "limit_renders",
        "limit_trajectories",
        "limit_event_clients",
        "limit_captures",
        "reconstruction_workers",
        "retention_days",
        "retention_bytes",
        "deleted_days",
        "render",
        "simd",
    }
)
"""What a request may change. Who may use the service, where it listens, and which files and addresses it reaches is
decided on its machine: otherwise a token of the service would be as good as an account there."""

Value = bool | int | float | str | None
"""Of a setting that a request may change; None: its default."""


def check_editable(changes: Mapping[str, Value], origins: Mapping[str, SettingOrigin]) -> None:
    """Raises ConfigurationError for a setting that a request cannot change, and says where it can be changed."""
    for name in changes:
        if name not in Settings.model_fields:
            raise ConfigurationError(f"there is no setting {name}; GET configuration lists them")
        if name not in EDITABLE:
            raise ConfigurationError(
                f"{name} is not changed by requests: change it in the file of settings, on the machine of the service"
            )
        if origins[name] is SettingOrigin.ENVIRONMENT:
            raise ConfigurationError(f"SPIKED_{name.upper()} is set and wins over the file: change it there")
        if origins[name] is SettingOrigin.FLAG:
            flag = flag_of(name).partition("=")[0]
            raise ConfigurationError(f"{name} is given by {flag} at the start and wins over the file: change it there")


class SettingsFile:
    """The file of settings while it is changed; it can be put back."""

    def __init__(self, path: Path | None) -> None:
        """The file that was read, or that of the user if none was. Raises ConfigurationError if it cannot be read."""
        self.path = own_file() if path is None else path
        try:
            self._before = self.path.read_text(encoding="utf-8") if self.path.exists() else None
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"{self.path} cannot be read: {error}") from error

    def change(self, changes: Mapping[str, Value], flags: Mapping[str, object]) -> None:
        """Write the file with these values, if they are valid; its other lines and comments stay.

        Raises ConfigurationError, and then it is as it was.
        """
        text = edited(self._before or "", changes)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(self.path) as part:
                part.write_text(text, encoding="utf-8")
                try:
                    load_settings(flags, part)
                except ConfigurationError as error:
                    raise ConfigurationError(f"{error}".replace(str(part), str(self.path))) from error
        except OSError as error:
            raise ConfigurationError(
                f"{self.path} cannot be written: {error.strerror}; change it on the machine of the service"
            ) from error

    def put_back(self) -> None:
        """Write what it was before. Raises OSError."""
        if self._before is None:
            self.path.unlink(missing_ok=True)
            return
        with whole_file(self.path) as part:
            part.write_text(self._before, encoding="utf-8")


def edited(text: str, changes: Mapping[str, Value]) -> str:
    """The text of a TOML file with these values; a key whose value is None is left out.

    Raises ConfigurationError for a text in which they cannot be changed line by line.
    """
    try:
        wanted = tomllib.loads(text)
        lines = text.splitlines()
        for name, value in changes.items():
            lines = _changed(lines, name, value)
            wanted.pop(name, None)
            if value is not None:
                wanted[name] = value
        after = "".join(f"{line}\n" for line in lines)
        found = tomllib.loads(after)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"the file of settings is no TOML: {error}; correct it first") from error
    if found != wanted:
        raise ConfigurationError("the file of settings has no line for each value: change it with an editor")
    return after


def _changed(lines: list[str], name: str, value: Value) -> list[str]:
    begins = re.compile(rf"""\s*["']?{name}["']?\s*=""")
    at = next((number for number, line in enumerate(lines) if begins.match(line)), None)
    if value is None:
        return lines if at is None else lines[:at] + lines[at + 1 :]
    line = f"{name} = {json.dumps(value)}"
    if at is None:
        return [*lines, line]
    return [*lines[:at], line + _comment(lines[at]), *lines[at + 1 :]]


def _comment(line: str) -> str:
    """The comment after a value without a # in it, with the space before."""
    found = re.search(r"\s*#.*$", line)
    return "" if found is None else found.group()
