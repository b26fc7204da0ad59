"""Rows, versions and files of reconstructions."""

import shutil
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Unpack

from spiked.errors import ConfigurationError
from spiked.recon.checkpoint_file import exists
from spiked.render import Camera
from spiked.sensor import Sensor
from spiked_service.base.errors import BusyError
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.reconstructions.queue_view import QueueView
from spiked_service.results.pinned_map import pin
from spiked_service.results.published import Published
from spiked_service.results.scene_scale import forget_scale
from spiked_service.results.timeline_writer import NAME as TIMELINE
from spiked_service.results.versions import Publisher, forget_incomplete, newest, version_row
from spiked_service.store.catalogue import Catalogue, Page, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import JobState, MapRef, ReconstructionEdit, ReconstructionRow, VersionRow
from spiked_service.store.snapshot import CaptureJobs

LISTED = 100
"""Reconstructions that are listed with their capture, at most: the newest."""
_Rows = Sequence[ReconstructionRow]
_ALL = 2**31
"""No limit."""


class ReconstructionRepository:
    """Reads, saves and publishes reconstructions. Thread-safe.

    The catalogue holds the rows; rows of running reconstructions and rows that could not be saved on a full disk are
    newer in memory. Queued rows are read with their place in the queue and the expected seconds to completion.
    """

    def __init__(self, folder: DataFolder, catalogue: Catalogue, notifier: Notifier, policy: QueuePolicy) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._notifier = notifier
        self._lock = threading.RLock()
        self._running: dict[str, ReconstructionRow] = {}
        self._view = QueueView(catalogue, notifier, policy, self._running, self._lock)
        self._order = self._view.order
        self._unsaved: dict[str, ReconstructionRow] = {}
        self._texts: dict[str, tuple[str, str]] = {}
        """Name and notes that users have given meanwhile: workers save rows that do not have them yet."""
        self._edited: set[str] = set()
        """Reconstructions of which `publish_edit` writes a version."""

    def get(self, reconstruction_id: str) -> ReconstructionRow:
        """The reconstruction as it is now. Raises UnknownIdError."""
        return self._current([self._catalogue.reconstructions.get(reconstruction_id)])[0]

    def page(
        self,
        limit: int = 50,
        cursor: str | None = None,
        capture_id: str | None = None,
        state: JobState | None = None,
    ) -> Page[ReconstructionRow]:
        """A page of reconstructions, newest first."""
        page = self._catalogue.reconstruction_page(limit, cursor, capture_id, state)
        return Page(self._current(page.items), page.next_cursor)

    def in_turn(self, limit: int = 50, cursor: str | None = None) -> Page[ReconstructionRow]:
        """A page of the queue, the next one first, with its length. Raises UnknownIdError; see `QueueOrder.page`."""
        page = self._order.page(limit, cursor)
        places = {row.id: row.queue_place or 0 for row in page.items}
        return Page(self._current(page.items, places), page.next_cursor, page.total)

    def jobs_of(self, capture_id: str) -> CaptureJobs:
        """The newest reconstructions of a capture, and how many there are."""
        return self.jobs_of_each([capture_id])[0]

    def jobs_of_each(self, capture_ids: Sequence[str]) -> list[CaptureJobs]:
        """Of each capture the newest reconstructions, and how many there are."""
        return [CaptureJobs(ids[::-1], total) for ids, total in self._catalogue.newest_jobs(capture_ids, LISTED)]

    def shown_of(self, capture_ids: Sequence[str]) -> list[ReconstructionRow]:
        """Of each capture the newest reconstruction with a version, else its newest that is no localisation, if any."""
        ids = [self._catalogue.shown_job(one) for one in capture_ids]
        rows = [self._catalogue.reconstructions.find(one) for one in ids if one is not None]
        return self._current([row for row in rows if row is not None])

    def queued(self, passed: Collection[str] = ()) -> Iterator[ReconstructionRow]:
        """Queued reconstructions that may begin, the next one first, without those that could not be saved.

        Those that read the recordings of captures that are `passed`, also meanwhile, are left out.
        """
        return (row for row in self._order.released(passed) if row.id not in self._unsaved)

    def interrupted(self) -> list[ReconstructionRow]:
        """Reconstructions that an earlier service left running."""
        return self._catalogue.reconstruction_page(_ALL, state=JobState.RUNNING).items

    def counts(self) -> dict[JobState, int]:
        """Number of reconstructions by state."""
        return self._catalogue.job_counts()

    def folder(self, reconstruction_id: str) -> Path:
        """Folder of its versions. Raises UnknownIdError."""
        return self._folder.reconstruction(self._catalogue.reconstructions.get(reconstruction_id).id)

    def log(self, reconstruction_id: str) -> Path:
        """Log file of its workers, which may not exist. Raises UnknownIdError."""
        return self.folder(reconstruction_id) / "log"

    def timeline(self, reconstruction_id: str) -> Path:
        """File of its timeline, which may not exist; see `timeline.Timeline`. Raises UnknownIdError."""
        return self.folder(reconstruction_id) / TIMELINE

    def versions(self, reconstruction_id: str) -> Sequence[VersionRow]:
        """Available versions, oldest first. Raises UnknownIdError."""
        return self._catalogue.versions(self._catalogue.reconstructions.get(reconstruction_id).id)

    def add(self, row: ReconstructionRow) -> ReconstructionRow:
        """Save a new row, with its turn in the queue. Raises StoreError, and then there is none."""
        with self._lock:
            row = self._order.fair(row)
            self._catalogue.reconstructions.put(row)
            self._view.tell(row, ran=False)
            return self._current([row])[0]

    def save(self, row: ReconstructionRow) -> ReconstructionRow:
        """Save and publish a row. A row that cannot be saved is kept in memory and retried."""
        if row.state.over:
            self.unpin_maps(row)
        with self._lock:
            row = self._named(row)
            try:
                row = self._write(row)
            except StoreError as error:
                if row.id not in self._unsaved:
                    self._notifier.log("error", str(error), row.capture_id, row.id)
                self._unsaved[row.id] = row = _stored(row)
            self._tell(row)
        return row

    def _write(self, row: ReconstructionRow) -> ReconstructionRow:
        """Put a row into the catalogue, and return it as it is there. Raises StoreError."""
        row = _stored(row)
        self._catalogue.reconstructions.put(row)
        self._unsaved.pop(row.id, None)
        return row

    def _tell(self, row: ReconstructionRow) -> None:
        """Publish a row that was written, and what changed in the queue."""
        ran = row.id in self._running
        self._set_running(row)
        self._view.tell(row, ran=ran)

    def forget_incomplete(self, reconstruction_id: str) -> list[int]:
        """List only whole versions of a job that has ended, and is not edited. The numbers of the others."""
        with self._lock:
            over = self.get(reconstruction_id).state.over and reconstruction_id not in self._edited
            return forget_incomplete(self.folder(reconstruction_id)) if over else []

    def publish_edit(self, reconstruction_id: str, version: int, edit: Callable[[Publisher], Published]) -> Published:
        """Publish another version of a reconstruction that has ended, made of its newest, `version`.

        Others read and save rows meanwhile: the files of a large scene take seconds. Raises UnknownIdError, OSError,
        and BusyError if it has not ended, is being edited, or has another newest version.
        """
        with self._lock:
            row = self.get(reconstruction_id)
            self.check_not_edited(row.id)
            if not row.state.over:
                raise BusyError(f"reconstruction {row.id} is {row.state}: wait for its end, or cancel it")
            if row.version != version:
                raise BusyError(f"version {row.version} is the newest now, not {version}: look at that one first")
            self._edited.add(row.id)
        try:
            publisher = Publisher(self.folder(row.id))
            published = edit(publisher)
            with self._lock:
                self.add_version(row, published, set(publisher.kept))
                now = self.get(row.id)
                self.save(replace(now, version=published.version, splats=published.splats, psnr_db=published.psnr_db))
        finally:
            with self._lock:
                self._edited.discard(row.id)
        return published

    def check_not_edited(self, reconstruction_id: str) -> None:
        """Raises BusyError while a version is made by hand."""
        with self._lock:
            if reconstruction_id in self._edited:
                raise BusyError(f"a version of reconstruction {reconstruction_id} is being written: try again")

    def requeue(self, row: ReconstructionRow) -> None:
        """Save the row of an ended reconstruction that is queued again.

        Raises BusyError while it is edited, StoreError, and then it has not changed.
        """
        with self._lock:
            self.check_not_edited(row.id)
            self._tell(self._write(self._order.fair(self._named(row))))

    def forget_scale(self, row: ReconstructionRow) -> None:
        """Forget the scale of a reconstruction that begins anew, since its unit of length will be another one.

        Raises OSError.
        """
        if forget_scale(self._folder.reconstruction(row.id), row.version):
            said = "its scale is forgotten: it begins anew, in another unit of length; measure it again"
            self._notifier.log("warning", said, row.capture_id, row.id)

    def update(self, row: ReconstructionRow) -> None:
        """Publish the row of a running reconstruction without saving it."""
        with self._lock:
            row = self._named(row)
            self._set_running(row)
            self._notifier.job(row)

    def change(self, reconstruction_id: str, **edit: Unpack[ReconstructionEdit]) -> ReconstructionRow:
        """Change the fields that are given, and publish the row.

        Raises UnknownIdError, StoreError, and BusyError if one that is not in the queue is to be held or moved.
        """
        name, notes, held, place = (edit.get(key) for key in ("name", "notes", "held", "queue_place"))
        with self._lock:
            row = self.get(reconstruction_id)
            if row.state is not JobState.QUEUED and (held, place) != (None, None):
                raise BusyError(
                    f"reconstruction {row.id} is {row.state}: only those that wait in the queue can be held or moved"
                )
            edited = replace(
                row if place is None else self._order.moved(row, int(f"{place}")),
                name=row.name if name is None else f"{name}",
                notes=row.notes if notes is None else f"{notes}",
                held=row.held if held is None else bool(held),
            )
            written = self._write(edited)
            self._texts[row.id] = edited.name, edited.notes
            self._tell(written)
            return self.get(row.id)

    def _named(self, row: ReconstructionRow) -> ReconstructionRow:
        name, notes = self._texts.get(row.id, (row.name, row.notes))
        return replace(row, name=name, notes=notes)

    def retry_saving(self) -> None:
        """Save rows that could not be saved on a full disk."""
        with self._lock:
            for row in list(self._unsaved.values()):
                self.save(self._running.get(row.id, row))

    def has_checkpoint(self, reconstruction_id: str) -> bool:
        """Whether an interrupted reconstruction can go on from where it was."""
        return exists(self._folder.checkpoint(reconstruction_id))

    def drop_checkpoint(self, reconstruction_id: str) -> None:
        """Let the next start of a reconstruction begin anew."""
        shutil.rmtree(self._folder.checkpoint(reconstruction_id), ignore_errors=True)

    def pin_maps(self, row: ReconstructionRow) -> ReconstructionRow:
        """Link the newest versions of the maps of a job into its folder; the row with their numbers.

        Raises UnknownIdError, ConfigurationError for a reconstruction that is no map, and StoreError.
        """
        found = []
        for folder, used in zip(self._folder.maps(row.id, len(row.maps)), row.maps, strict=True):
            map_row, source, published, sensor = _map_of(self._catalogue, self._folder, used.reconstruction_id)
            try:
                pin(folder, map_row, source, published, sensor)
            except FileNotFoundError as error:
                raise ConfigurationError(f"{error.filename} has just been removed: try again") from error
            except OSError as error:
                raise StoreError(f"the map cannot be linked into {folder}: {error.strerror}") from error
            found.append(MapRef(map_row.id, published.version))
        return replace(row, maps=tuple(found))

    def unpin_maps(self, row: ReconstructionRow) -> None:
        """Let the maps of a job go that has ended."""
        for folder in self._folder.maps(row.id, len(row.maps)):
            shutil.rmtree(folder, ignore_errors=True)

    def map_camera(self, reconstruction_id: str) -> Camera:
        """The camera that made a map. Raises UnknownIdError, and ConfigurationError for what is no map."""
        _, _, published, sensor = _map_of(self._catalogue, self._folder, reconstruction_id)
        return Camera(published.optics(sensor), sensor.width, sensor.height)

    def add_version(self, row: ReconstructionRow, published: Published, kept: set[int]) -> None:
        """Save a published version and forget those that are not in `kept`. Errors are logged."""
        try:
            self._catalogue.put_version(version_row(row.id, published), kept)
        except StoreError as error:
            self._notifier.log("error", str(error), row.capture_id, row.id)

    def remove(self, reconstruction_id: str) -> None:
        """Delete a reconstruction with its versions and files. Raises BusyError while it is edited."""
        with self._lock:
            self.check_not_edited(reconstruction_id)
            self.clear([reconstruction_id])

    def clear(self, ids: Sequence[str]) -> None:
        """Delete reconstructions: files first, so that a kill leaves none without a row. Raises StoreError."""
        for one in ids:
            self._folder.remove(self._folder.reconstruction(one))
        with self._lock:
            self._catalogue.freeing(self._catalogue.remove_jobs, ids)
            for one in ids:
                self._unsaved.pop(one, None)
                self._texts.pop(one, None)
                self._view.forget(one)

    def check_none_edited(self, capture_id: str) -> None:
        """Raises BusyError while a reconstruction of a capture is edited."""
        with self._lock:
            for one in (edited for edited in self._edited if self.get(edited).capture_id == capture_id):
                self.check_not_edited(one)

    def close(self) -> None:
        """End the thread that tells of changed places."""
        self._view.close()

    def _set_running(self, row: ReconstructionRow) -> None:
        if row.state is JobState.RUNNING:
            self._running[row.id] = row
        else:
            self._running.pop(row.id, None)

    def _current(self, rows: _Rows, places: Mapping[str, int] | None = None) -> list[ReconstructionRow]:
        with self._lock:
            found = [self._running.get(row.id) or self._unsaved.get(row.id, row) for row in rows]
            return self._view.placed(found, places)


def _stored(row: ReconstructionRow) -> ReconstructionRow:
    """A row as the catalogue has it: places in the queue, and expectations of what is over, are not kept."""
    return replace(row, queue_place=None, eta_s=None if row.state.over else row.eta_s)


def _map_of(
    catalogue: Catalogue, folder: DataFolder, reconstruction_id: str
) -> tuple[ReconstructionRow, Path, Published, Sensor]:
    row = catalogue.reconstructions.get(reconstruction_id)
    files, capture = folder.reconstruction(row.id), catalogue.captures.get(row.capture_id)
    published = newest(files)
    if published is None or capture.sensor is None:
        raise ConfigurationError(f"reconstruction {row.id} has no version, so it is no map")
    return row, files, published, capture.sensor
