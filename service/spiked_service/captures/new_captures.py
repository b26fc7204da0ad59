"""Captures before they run: whether their devices are free, and their rows, folders and space on the disk."""

from collections.abc import Callable, Collection, Iterable
from datetime import UTC, datetime

from spiked_driver import open_camera

from spiked.errors import ConfigurationError
from spiked_service.base.errors import BusyError
from spiked_service.base.ids import new_id
from spiked_service.captures.live_capture import LiveCapture
from spiked_service.captures.sources import device_of
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.disk_space import DiskSpace, recording_bytes
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, CaptureState, Origin, Plan


def check_free(devices: Collection[str], live: Iterable[LiveCapture], armed: Collection[str], limit: int) -> None:
    """Raises BusyError if a live capture has one of the devices, or if more than `limit` would be in use."""
    in_use = set(armed)
    for other in live:
        if not other.holds_device:
            continue
        device = device_of(other.row.source)
        if device in devices and not other.row.state.over:
            raise BusyError(f"capture {other.id} is still running on {device}: stop it, or wait for its end")
        in_use.add(device)
    if len(in_use | set(devices)) > limit:
        wanted = f" and {len(devices)} are asked for" if len(devices) > 1 else ""
        raise BusyError(
            f"{len(in_use)} devices are in use{wanted}, {limit} are allowed: stop a capture, disarm a device, "
            "or raise the setting limit_captures"
        )


def group_devices(plans: Iterable[Plan]) -> list[str]:
    """The devices of a group. Raises ConfigurationError for one that is named twice."""
    devices = [device_of(plan.source) for plan in plans]
    for device in devices:
        if devices.count(device) > 1:
            raise ConfigurationError(f"{device} is named twice in the group: name each device once")
    return devices


class NewCaptures:
    """Makes captures that have not begun, and takes them back."""

    def __init__(
        self,
        folder: DataFolder,
        catalogue: Catalogue,
        disk_space: DiskSpace,
        reconstructions: Reconstructions,
        notifier: Notifier,
        changed: Callable[[LiveCapture], None],
    ) -> None:
        """`changed` is called whenever a capture has changed."""
        self._folder = folder
        self._catalogue = catalogue
        self._disk_space = disk_space
        self._reconstructions = reconstructions
        self._notifier = notifier
        self._changed = changed

    def size_of(self, plan: Plan) -> int | None:
        """Bytes of the recording, None if its end is not known. Raises as the camera does that cannot be used."""
        source = open_camera(plan.source, profiles=self._folder.profiles).source
        return recording_bytes(plan, source.sensor, source.frames)

    def create(self, plan: Plan, size: int | None, group: str | None) -> LiveCapture:
        """A capture with its row and folder; `size` bytes are reserved for its recording. Raises StoreError."""
        now = datetime.now(UTC)
        row = CaptureRow(
            new_id(),
            Origin.LIVE,
            plan,
            CaptureState.STARTING,
            now,
            name=plan.name,
            notes=plan.notes,
            group=group,
            frames_planned=plan.frames,
        )
        if plan.record:
            self._disk_space.reserve_recording(self._folder.recording(row.id), size)
        try:
            (self._folder.capture(row.id) / "logs").mkdir(parents=True)
            self._catalogue.captures.put(row)
        except (OSError, StoreError) as error:
            self._disk_space.release(self._folder.recording(row.id))
            self._folder.remove(self._folder.capture(row.id))
            if isinstance(error, StoreError):
                raise
            raise StoreError(f"{self._folder.path} cannot be written: {error.strerror}") from error
        return LiveCapture(row, self._folder, self._catalogue, self._reconstructions, self._notifier, self._changed)

    def undo(self, capture: LiveCapture) -> None:
        """Remove a capture that has not begun. A row that cannot be removed is logged."""
        self._disk_space.release(self._folder.recording(capture.id))
        self._folder.remove(self._folder.capture(capture.id))
        try:
            self._catalogue.freeing(self._catalogue.captures.remove, capture.id)
        except StoreError as error:
            self._notifier.log("error", f"capture {capture.id}, which has not begun, is still listed: {error}")
