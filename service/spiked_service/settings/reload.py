"""Settings that can be reloaded while the service runs."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked_service.settings.editing import SettingsFile, Value, check_editable
from spiked_service.settings.settings import Configuration, Settings, load_settings, reloadable


@dataclass(frozen=True)
class Reloaded:
    """Result of a reload."""

    changed: list[str]
    """Settings that changed and are in effect."""
    waiting: list[str]
    """Settings that differ but take effect after a restart."""


class ReloadableSettings:
    """The settings in effect. Thread-safe."""

    def __init__(self, flags: Mapping[str, object] | None = None, file: Path | None = None) -> None:
        """Raises ConfigurationError."""
        self._flags = dict(flags or {})
        self._file = file
        self._lock = threading.Lock()
        self._configuration = load_settings(self._flags, file)
        self._listeners: list[Callable[[Settings], None]] = []

    @property
    def now(self) -> Settings:
        """The settings in effect."""
        return self._configuration.settings

    @property
    def configuration(self) -> Configuration:
        """The settings in effect with their origins."""
        return self._configuration

    def on_change(self, listener: Callable[[Settings], None]) -> None:
        """Call `listener` with the settings now and after each change."""
        listener(self.now)
        self._listeners.append(listener)

    def reload(self) -> Reloaded:
        """Read file and environment again and apply what can be reloaded. On ConfigurationError nothing changes."""
        with self._lock:
            return self._reload()

    def change(self, changes: Mapping[str, Value]) -> Reloaded:
        """Write values into the file of settings, and reload it. On ConfigurationError nothing changes."""
        with self._lock:
            after = load_settings(self._flags, self._file)
            check_editable(changes, after.origins)
            file = SettingsFile(after.file)
            file.change(changes, self._flags)
            try:
                return self._reload()
            except ConfigurationError:
                file.put_back()
                raise

    def waiting(self) -> list[str]:
        """Settings whose value in file and environment takes effect after a restart. Raises ConfigurationError."""
        after = load_settings(self._flags, self._file)
        return [name for name in _differences(self.now, after.settings) if not reloadable(name)]

    def _reload(self) -> Reloaded:
        before = self._configuration
        after = load_settings(self._flags, self._file)
        old, new = before.settings, after.settings
        names = _differences(old, new)
        changed = [name for name in names if reloadable(name)]
        values = {name: getattr(new, name) for name in changed}
        origins = {**before.origins, **{name: after.origins[name] for name in changed}}
        try:
            self._take(Configuration(old.model_copy(update=values), origins, after.file))
        except ConfigurationError:
            self._take(before)
            raise
        return Reloaded(changed, [name for name in names if name not in changed])

    def _take(self, configuration: Configuration) -> None:
        self._configuration = configuration
        for listener in self._listeners:
            listener(self.now)


def _differences(old: Settings, new: Settings) -> list[str]:
    return [name for name in Settings.model_fields if getattr(old, name) != getattr(new, name)]
