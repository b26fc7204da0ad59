"""Which sources a request may name: devices, and files in the folders that the settings open."""

from pathlib import Path

from spiked.errors import SourceError
from spiked_service.captures import unhurried
from spiked_service.devices import Device, known_devices
from spiked_service.live import LiveSettings
from spiked_service.store.catalogue import UnknownIdError

_FILE_KINDS = ("replay", "pcie")


class Sources:
    """Checks what requests say; the command line may name any file."""

    def __init__(self, settings: LiveSettings) -> None:
        self._settings = settings
        self._here = Path.cwd()

    def devices(self) -> list[Device]:
        """What captures can be started from."""
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
        return unhurried(source)

    def _check(self, source: str) -> None:
        kind, _, rest = source.partition(":")
        if kind not in _FILE_KINDS:
            return
        name = rest.partition("?")[0]
        folders = [Path(folder) for folder in self._settings.now.source_folders] or [self._here]
        try:
            path = (self._here / name).resolve()
            inside = any(path.is_relative_to(folder.resolve()) for folder in folders)
        except (OSError, ValueError, RuntimeError):  # too long, with a zero byte, links in a circle
            inside = False
        if not inside:
            raise SourceError(
                f"{source.partition('?')[0]} is not in a folder whose files requests may name; start the service in "
                "that folder, add it to source_folders, or upload the recording"
            )
