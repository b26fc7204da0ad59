"""All captures: live, ended and uploaded."""

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from spiked_driver import open_camera

from spiked.errors import ConfigurationError
from spiked_service.base.errors import BusyError
from spiked_service.base.ids import new_id
from spiked_service.captures.armed_device import ArmedDevice
from spiked_service.captures.live_capture import LiveCapture
from spiked_service.captures.new_captures import NewCaptures, check_free, group_devices
from spiked_service.captures.purging import Purging
from spiked_service.captures.recent import Recent
from spiked_service.captures.removal import Removal
from spiked_service.captures.ring_counts import RingCount
from spiked_service.captures.sources import device_of, realtime
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.store.capture_listing import CaptureFilter, CaptureSort
from spiked_service.store.catalogue import Catalogue, Page, StoreError, UnknownIdError
from spiked_service.store.disk_space import DiskSpace, recording_bytes
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureEdit, CaptureRow, Plan
from spiked_service.store.snapshot import CaptureJobs, Snapshot
from spiked_service.workers.messages import PreviewTaken

_CLOSE_S = 1.0
"""Workers exit within 0.8 s of their dismissal (`channel._EXIT_S`); later they are killed."""
MOST_GROUPED = 16
"""Captures in a group, at most."""
_TICK_S = 0.5
"""Interval at which states follow the counters and live captures are published."""


class Captures:
    """Starts, lists and removes captures; one live capture per device. Thread-safe."""

    def __init__(
        self,
        folder: DataFolder,
        catalogue: Catalogue,
        disk_space: DiskSpace,
        reconstructions: Reconstructions,
        notifier: Notifier,
    ) -> None:
        self._disk_space = disk_space
        self._folder = folder
        self._catalogue = catalogue
        self._reconstructions = reconstructions
        self._notifier = notifier
        self.limit = 4
        """Most devices in use at a time; may be changed at any time."""
        self._new = NewCaptures(folder, catalogue, disk_space, reconstructions, notifier, self._changed)
        self._lock = threading.RLock()
        self._live: dict[str, LiveCapture] = {}
        self._armed: dict[str, ArmedDevice] = {}
        self._recent = Recent()
        self.purging = Purging(folder, catalogue, reconstructions.rows, notifier)
        self.removal = Removal(catalogue, reconstructions, self.purging, self)
        self._closing = threading.Event()
        self._ticker = threading.Thread(target=self._tick, name="counters", daemon=True)
        self._ticker.start()

    def start(self, plan: Plan) -> Snapshot:
        """Start a capture; with a pre-trigger time it starts in the past of an armed device.

        Raises BusyError if the device or as many devices as allowed are in use, or the service is stopping;
        SourceError, RecordingError or ConfigurationError for a source that cannot be used; StoreError if the capture
        cannot be saved.
        """
        if not (plan.record or plan.reconstruct):
            raise ConfigurationError("the capture would neither record nor reconstruct: enable one of them")
        device = device_of(plan.source)
        with self._lock:
            armed_device = self._armed.get(device)
        if armed_device is not None:
            armed_device.check(plan, self._folder.profiles)
            size = recording_bytes(plan, armed_device.sensor, None)
        elif plan.pretrigger_s:
            raise ConfigurationError(f"{device} is not armed, so it has no earlier frames: arm the device first")
        else:
            size = self._new.size_of(plan)
        with self._lock:
            self._refuse_if_busy(device)
            if self._armed.get(device) is not armed_device:
                raise BusyError(f"{device} has been armed or disarmed meanwhile: try again")
            capture = self._begin(plan, size)
            self._armed.pop(device, None)
            if armed_device is None:
                try:
                    capture.acquire()
                except OSError as error:
                    self._undo(capture)
                    raise BusyError(f"no worker can be started: {error.strerror}; end other programs") from error
        if armed_device is not None:
            armed_device.trigger(capture, plan)
        return self.publish(capture.id)

    def start_group(self, plans: Sequence[Plan]) -> str:
        """Start a capture on each of several devices, or none at all; returns the id of the group.

        Raises as `start`, and ConfigurationError for a device that is named twice or that is armed.
        """
        devices, sizes = group_devices(plans), [self._new.size_of(plan) for plan in plans]
        group, created = new_id(), list[LiveCapture]()
        with self._lock:
            self._refuse_if_busy(*devices)
            for device, plan in zip(devices, plans, strict=True):
                if device in self._armed or plan.pretrigger_s:
                    raise ConfigurationError(
                        f"{device} is armed or has a pre-trigger time: groups start now; disarm it"
                    )
            try:
                for plan, size in zip(plans, sizes, strict=True):
                    created.append(self._begin(plan, size, group))
                for capture in created:
                    capture.acquire()
                failed = None
            except (OSError, StoreError) as error:
                failed = error
                running = [capture for capture in created if capture.holds_device]
                for capture in created:
                    if capture not in running:
                        self._undo(capture)
        if failed is not None:
            for capture in running:  # without the lock, as in `change`; their rows say why they are short
                capture.stop()
            if isinstance(failed, StoreError):
                raise failed
            raise BusyError(f"no worker can be started: {failed.strerror}; end other programs") from failed
        for capture in created:
            self.publish(capture.id)
        return group

    def group(self, group_id: str) -> Sequence[Snapshot]:
        """The captures of a group in the order of the request. Raises UnknownIdError."""
        rows = self._catalogue.capture_page(MOST_GROUPED, group=group_id).items
        if not rows:
            raise UnknownIdError(f"there is no group {group_id} of captures")
        return self.snapshots(sorted(rows, key=lambda row: row.id))

    def _begin(self, plan: Plan, size: int | None, group: str | None = None) -> LiveCapture:
        capture = self._new.create(plan, size, group)
        self._live[capture.id] = capture
        return capture

    def _undo(self, capture: LiveCapture) -> None:
        """Remove a capture that has not begun."""
        del self._live[capture.id]
        self._new.undo(capture)

    def arm(self, source: str, pretrigger_s: float) -> ArmedDevice:
        """Run a device without recording; its ring holds the newest frames for a later capture.

        Raises as `start`.
        """
        device = device_of(source)
        open_camera(source, profiles=self._folder.profiles)  # errors are raised here rather than in the worker
        with self._lock:
            self._refuse_if_busy(device)
            if device in self._armed:
                raise BusyError(f"{device} is armed already: disarm it first to change its pre-trigger time")
            armed_device = self._armed[device] = ArmedDevice(
                realtime(source), pretrigger_s, self._folder, self._notifier, self._disarmed
            )
            return armed_device

    def disarm(self, source: str) -> None:
        """Stop an armed device. Does nothing if it is not armed."""
        with self._lock:
            armed_device = self._armed.pop(device_of(source), None)
        if armed_device is not None:
            armed_device.dismiss()
            armed_device.join(_CLOSE_S)
            self._recent.add_ring(armed_device.ring_count(over=True))

    def armed(self) -> dict[str, ArmedDevice]:
        """The armed devices."""
        with self._lock:
            return dict(self._armed)

    def get(self, capture_id: str) -> Snapshot:
        """The capture as it is now. Raises UnknownIdError."""
        with self._lock:
            live = self._live.get(capture_id)
        return self.snapshot(live.row if live is not None else self._catalogue.captures.get(capture_id))

    def publish(self, capture_id: str) -> Snapshot:
        """Publish the capture as it is now. Raises UnknownIdError."""
        snapshot = self.get(capture_id)
        self._notifier.capture(snapshot)
        return snapshot

    def snapshot(self, row: CaptureRow) -> Snapshot:
        """A row with its current counters and the ids of its newest reconstructions."""
        return self.snapshots([row])[0]

    def snapshots(self, rows: Sequence[CaptureRow]) -> Sequence[Snapshot]:
        """Each as `snapshot` returns it."""
        jobs = self._reconstructions.rows.jobs_of_each([row.id for row in rows])
        with self._lock:
            live = [self._live.get(row.id) for row in rows]
        return [_snapshot(*each) for each in zip(rows, live, jobs, strict=True)]

    def list(
        self,
        limit: int = 50,
        cursor: str | None = None,
        sort: CaptureSort = CaptureSort.STARTED,
        descending: bool = True,
        **wanted: Unpack[CaptureFilter],
    ) -> Page[CaptureRow]:
        """Newest first, unless another order is wanted. See `Catalogue.capture_page`."""
        return self._catalogue.capture_page(limit, cursor, sort, descending, **wanted)

    def live(self) -> Sequence[Snapshot]:
        """Captures that have not ended, oldest first."""
        return [self.snapshot(capture.row) for capture in self._kept() if not capture.row.state.over]

    def rings(self) -> Sequence[RingCount]:
        """What the rings of armed devices and captures have counted, and the last ones that are over."""
        with self._lock:
            running = [one.ring_count() for one in self._all()]
            counts = [*(count for count in running if count is not None), *self._recent.rings()]
        return list({count.ring_id: count for count in counts}.values())

    def recording(self, capture_id: str) -> Path:
        """Path of its `.dat`, which may not exist or still grow. Raises UnknownIdError."""
        return self._folder.recording(self._catalogue.captures.get(capture_id).id)

    def picture(self, capture_id: str) -> PreviewTaken | None:
        """The newest preview of a live capture, or the last of a recent one; None if there is none."""
        with self._lock:
            live = self._live.get(capture_id)
        return self._recent.picture(capture_id) if live is None else live.picture

    def stop(self, capture_id: str) -> Snapshot:
        """End the acquisition; a second call ends the refinement as well. Raises UnknownIdError."""
        with self._lock:
            live = self._live.get(capture_id)
        if live is not None:
            live.stop()
        return self.get(capture_id)

    def update(self, capture_id: str, **edit: Unpack[CaptureEdit]) -> Snapshot:
        """Change what a user may change; None leaves it. Raises UnknownIdError."""
        return self.change(capture_id, **{key: value for key, value in edit.items() if value is not None})

    def change(self, capture_id: str, **fields: object) -> Snapshot:
        """Change fields of the row, and publish it. Raises UnknownIdError, StoreError."""
        with self._lock:
            live = self._live.get(capture_id)
        if live is not None:  # without the lock, because the capture calls back and takes it
            live.edit(**fields)
        else:
            with self.removal.no_purge():
                self._catalogue.captures.set(capture_id, **fields)
        return self.publish(capture_id)

    def forget(self, capture_id: str) -> None:
        """It is deleted for good: its picture, too."""
        self._recent.drop_picture(capture_id)

    def processes(self) -> dict[str, dict[str, int]]:
        """Process ids of the running workers by capture and role, without reconstructions."""
        return {capture.id: capture.processes() for capture in self._kept()}

    def dismiss(self) -> None:
        """Ask every worker to exit at once; no capture can be started afterwards."""
        self._closing.set()
        for one in self._all():
            one.dismiss()
        self._reconstructions.dismiss()

    def close(self) -> None:
        """End every worker within `_CLOSE_S`."""
        self.dismiss()
        for one in self._all():
            one.join(_CLOSE_S)
        self._reconstructions.join(_CLOSE_S)
        self._ticker.join()

    def retry_saving(self) -> None:
        """Save rows that could not be saved on a full disk."""
        for capture in self._kept():
            if capture.row.state.over and capture.save():
                with self._lock:
                    self._live.pop(capture.id, None)

    def _kept(self) -> Sequence[LiveCapture]:
        """Live captures, and ended ones whose rows are not saved."""
        with self._lock:
            return list(self._live.values())

    def _all(self) -> Sequence[LiveCapture | ArmedDevice]:
        with self._lock:
            return [*self._live.values(), *self._armed.values()]

    def _refuse_if_busy(self, *devices: str) -> None:
        if self._closing.is_set():
            raise BusyError("the service is stopping; restart it to capture")
        check_free(devices, self._live.values(), self._armed, self.limit)

    def _disarmed(self, armed_device: ArmedDevice) -> None:
        """An armed device has failed."""
        with self._lock:
            for device, one in list(self._armed.items()):
                if one is armed_device:
                    del self._armed[device]
                    self._recent.add_ring(armed_device.ring_count(over=True))

    def _changed(self, capture: LiveCapture) -> None:
        self._notifier.capture(self.snapshot(capture.row))
        if not capture.row.state.over:
            return
        self._disk_space.release(self._folder.recording(capture.id))
        with self._lock:
            self._recent.add(capture.id, capture.picture)
            self._recent.add_ring(capture.ring_count())
            saved = self._catalogue.captures.find(capture.id)
            if saved is not None and saved.state.over:
                self._live.pop(capture.id, None)

    def _tick(self) -> None:
        while not self._closing.wait(_TICK_S):
            try:
                for capture in self._kept():
                    capture.update_state()
                for snapshot in self.live():
                    self._notifier.capture(snapshot)
            except StoreError as error:  # the next tick repeats it
                self._notifier.log("error", f"the states of live captures are not up to date: {error}")


def _snapshot(row: CaptureRow, live: LiveCapture | None, jobs: CaptureJobs) -> Snapshot:
    """A capture as it is now; of a live one, its row is newer than `row`."""
    row = row if live is None else live.row
    if live is None or row.state.over:
        return Snapshot(row, row.counters, jobs)
    return Snapshot(row, live.counters(), jobs, None if live.opened is None else live.opened.name)
