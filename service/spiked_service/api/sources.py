"""Sources allowed in requests: devices, and files in the folders of the settings."""

from pathlib import Path
from urllib.parse import parse_qsl

from pydantic import BaseModel
from spiked_driver.source_kind import Device, SourceSpec
from spiked_driver.source_kinds import find_kind, known_devices

from spiked.camera import CameraFiles
from spiked.errors import SourceError
from spiked_service.captures.sources import unpaced, with_options
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

    def named(
        self,
        source: str | None,
        device: str | None,
        camera: BaseModel | None = None,
        noise: BaseModel | None = None,
    ) -> str:
        """The source of a request, with what it states of the camera and of its noise among its options.

        Raises UnknownIdError for a device, SourceError for a file not open to requests.
        """
        if source is None:
            found = next((one.source for one in self.devices() if one.source == device), None)
            if found is None:
                raise UnknownIdError(f"there is no device {device}; GET devices lists them")
            source = found
        elif source not in self._settings.now.devices:
            self._check(source)
        if camera is not None:
            stated = with_options(SourceSpec.parse(source).address, camera)
            self._check_files(stated)
            source = with_options(source, camera)
        if noise is not None:
            source = with_options(source, noise)
        return unpaced(source)

    def check_file(self, path: str, *allowed: Path) -> None:
        """Raises SourceError for a file that requests may not name; files in the folders `allowed` they may."""
        self._check_path(path, path, *allowed)

    def _check(self, source: str) -> None:
        kind, spec = find_kind(source), SourceSpec.parse(source)
        known = {SourceSpec.parse(device.source).address for device in self.devices()}
        if kind is not None and kind.takes_path and spec.address not in known:
            self._check_path(spec.target or "", spec.address)
        self._check_files(source)

    def _check_files(self, source: str) -> None:
        for name, path in parse_qsl(SourceSpec.parse(source).query):
            if name in CameraFiles.model_fields:
                self._check_path(path, f"{name}={path}")

    def _check_path(self, text: str, shown: str, *allowed: Path) -> None:
        configured = [Path(folder) for folder in self._settings.now.source_folders]
        folders = [*allowed, *(configured or [self._here])]
        try:
            path = (self._here / text).resolve()
            inside = any(path.is_relative_to(folder.resolve()) for folder in folders)
        except (OSError, ValueError, RuntimeError):  # too long, with a zero byte, links in a circle
            inside = False
        if not inside:
            raise SourceError(
                f"{shown} is not in a folder whose files requests may name; start the service in "
                "that folder, add it to source_folders, or upload the recording"
            )
