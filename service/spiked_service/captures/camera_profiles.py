"""The folder of camera profiles: what captures take from it, and calibrations made of captures."""

import threading
from collections.abc import Iterable
from pathlib import Path

from spiked_driver import open_camera
from spiked_driver.source_kind import Device, SourceSpec
from spiked_driver.spec import stored_profile

from spiked.calibration import Calibration
from spiked.camera import CameraFiles
from spiked.errors import ProfileError
from spiked.profile import SHARED_SERIALS, CameraProfile, profile_path
from spiked.recording import Recording, read_sidecar, sidecar_path
from spiked_service.base.ids import new_id
from spiked_service.captures.sources import same_device, with_options
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import CaptureRow, Origin

MEASURED = "calibration-"
"""Names of the calibrations that are made here begin so."""


class CameraProfiles:
    """Reads, replaces and completes the profiles of devices. Thread-safe.

    A profile is kept by the camera's serial number, or by the device's address if the number is missing or not its own.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._measuring = threading.Lock()

    def file(self, device: Device) -> Path:
        """The file of a device's profile. Raises UnknownIdError without one."""
        path = stored_profile(device, self.folder)
        if path is None:
            raise UnknownIdError(f"device {device.source} has no profile; PUT one")
        return path

    def replace(self, device: Device, profile: CameraProfile) -> Path:
        """Store a profile; captures that run keep theirs. Returns its file.

        It is opened with the device before it replaces the one before. Raises SpikedError for one that cannot be used.
        """
        path = profile_path(self.folder, SourceSpec.parse(device.source).address, device.serial)
        trial = path.with_name(f".{path.name}.{new_id()}.part")
        try:
            profile.write(trial)
            open_camera(with_options(device.source, CameraFiles(profile=trial)))
            trial.replace(path)
        finally:
            trial.unlink(missing_ok=True)
        return path

    def remove(self, device: Device) -> None:
        """Remove the profile of a device. Raises UnknownIdError without one."""
        self.file(device).unlink(missing_ok=True)

    def calibration(self, device: Device) -> Path | None:
        """The file of gains, dark rates and dead pixels that captures of the device are made with, if any."""
        stored = stored_profile(device, self.folder)
        named = None if stored is None else CameraProfile.read(stored).calibration
        return None if named is None else self.folder / named

    def remove_unused_calibrations(self, sources: Iterable[str]) -> None:
        """Remove the calibrations made here that no profile and no source names. Nothing may read them meanwhile.

        While a profile cannot be read, all stay.
        """
        stated = list(sources)
        with self._measuring:
            try:
                named = {CameraProfile.read(path).calibration for path in self.folder.glob("*.json")}
            except ProfileError:
                return
            for path in self.folder.glob(f"{MEASURED}*.npz"):
                if Path(path.name) not in named and not any(path.name in source for source in stated):
                    path.unlink(missing_ok=True)

    def calibrate(self, device: Device, flat: Recording | None, dark: Recording | None) -> tuple[Path, Calibration]:
        """Measure gains and dark rates, and store them with the device's profile. Returns its file.

        What one recording does not say stays as it was. Raises CalibrationError, and leaves the profile as it was.
        """
        with self._measuring:
            stored, known = stored_profile(device, self.folder), self.calibration(device)
            before = None if known is None or not known.exists() else Calibration.read(known)
            measured = Calibration.measure(flat, dark, None if flat is not None and dark is not None else before)
            profile = CameraProfile() if stored is None else CameraProfile.read(stored)
            # A new name: armed devices and captures that start meanwhile still read the one before.
            path = self.folder / f"{MEASURED}{new_id()}.npz"
            try:
                measured.write(path)
                file = self.replace(device, profile.model_copy(update={"calibration": Path(path.name)}))
            except BaseException:
                path.unlink(missing_ok=True)
                raise
            return file, measured


def of_another_camera(row: CaptureRow, recording: Recording, device: Device) -> str | None:
    """What shows that a capture is not of the device's camera; None if nothing does.

    Serial numbers decide where both are known, else the source of a live capture. An upload without a serial number may
    be of any camera.
    """
    profile = read_sidecar(sidecar_path(recording.path)).profile or {}
    serial = profile.get("serial")
    if not {serial, device.serial} & {None, *SHARED_SERIALS}:
        return None if serial == device.serial else f"camera {serial}"
    if row.origin is Origin.LIVE and not same_device(row.source, device):
        return f"the device {row.source}"
    return None
