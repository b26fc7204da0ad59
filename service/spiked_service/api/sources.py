"""Sources allowed in requests: devices, and files in the folders of the settings."""

from pathlib import Path

from spiked_driver.source_kind import Device, SourceSpec
from spiked_driver.source_kinds import find_kind, known_devices

from spiked.errors import SourceError
from spiked_service.captures.sources import unpaced
from spiked_service.settings.reload import ReloadableSettings
from spiked_service.store.catalogue import UnknownIdError


class Sources:
    """Validates the sources of requests; the command line may use any file."""

    def __init__(self, settings: ReloadableSettings) -> None:
        self._settings = settings
        self._here = Path.cwd()

    def devices(self) -> list[Device]:
        """The devices."""
        return known_devices(self._settings.now.devices)

    def named(self, source: str | None, device: str | None) -> str:
        """The source of a request. Raises UnknownIdError for a device, SourceError for a file not open to it."""
        if source is None:
            found = next((one.source for one in self.devices() if one.source == device), None)
            if found is None:
                raise UnknownIdError(f"there is no device {device}; GET devices lists them")
            source = found
        elif source not in self._settings.now.devices:
            self._check(source)
        return unpaced(source)

    def _check(self, source: str) -> None:
        kind, spec = find_kind(source), SourceSpec.parse(source)
        if kind is None or not kind.takes_path:
            return
        folders = [Path(folder) for folder in self._settings.now.source_folders] or [self._here]
        try:
            path = (self._here / (spec.target or "")).resolve()
            inside = any(path.is_relative_to(folder.resolve()) for folder in folders)
        except (OSError, ValueError, RuntimeError):  # too long, with a zero byte, links in a circle
            inside = False
        if not inside:
            raise SourceError(
                f"{spec.address} is not in a folder whose files requests may name; start the service in "
                "that folder, add it to source_folders, or upload the recording"
            )
