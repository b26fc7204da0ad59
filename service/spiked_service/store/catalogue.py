"""The catalogue: one SQLite file in WAL mode, one writer at a time, readers that never wait for it."""

import json
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, ParamSpec, Protocol, TypeVar, Unpack

from pydantic import TypeAdapter, ValidationError

from spiked.errors import SpikedError
from spiked_service.store.capture_listing import SORT_KEYS, CaptureFilter, CaptureSort, matching
from spiked_service.store.disk_reserve import DiskReserve
from spiked_service.store.folder import DataFolder
from spiked_service.store.migrations import MIGRATIONS, copy_before_migration, migrate, schema_of, written_by
from spiked_service.store.row_copies import RowCopies
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    Grade,
    JobState,
    ReconstructionRow,
    UploadRow,
    VersionRow,
)
from spiked_service.store.written_rows import WrittenRows

NOT_PURGED = "capture_id NOT IN (SELECT capture_id FROM purges)"
"""SQL condition of rows of jobs: those of captures that were purged are gone for whoever reads."""
_THERE = "value NOT IN (SELECT capture_id FROM purges)"
_NEWEST_JOBS = (
    f"SELECT value, iif({_THERE}, (SELECT group_concat(id) FROM "
    "(SELECT id FROM jobs WHERE capture_id = value ORDER BY id DESC LIMIT ?)), NULL), "
    f"iif({_THERE}, (SELECT coalesce(sum(jobs), 0) FROM job_counts WHERE capture_id = value), 0) "
    "FROM json_each(?)"
)
"""One row for each capture of a list: a row for each of so many ids would take most of the time."""
_WAIT_S = 5.0
"""Longest wait for another process that writes the catalogue, seconds."""
_CopyOf = Callable[[str], Path]
_DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class StoreError(SpikedError):
    """The catalogue cannot be read or written: the disk is full, broken or read-only."""


class DamagedError(StoreError):
    """The file of the catalogue is not a database or is damaged."""


class UnknownIdError(SpikedError):
    """There is no row with this id."""


class Row(Protocol):
    """A row with an id."""

    @property
    def id(self) -> str:
        """A UUID version 7."""
        ...


_Row = TypeVar("_Row", bound=Row)
_Given = ParamSpec("_Given")
_Done = TypeVar("_Done")


@dataclass(frozen=True)
class Page(Generic[_Row]):
    """A page of rows, newest first, and the cursor of the next page."""

    items: list[_Row]
    next_cursor: str | None
    """None on the last page."""
    total: int | None = None
    """Rows on all pages, where they were counted."""


class Catalogue:
    """Rows by id. Every method may be called from any thread, raises StoreError, and is one short transaction.

    A row is kept as one JSON document; columns made from it serve the queries. In a data folder a copy of the document
    lies beside the files that it is about: as new as what was answered, so it replaces a row that was lost; see
    docs/decisions/0054-copies-after-the-commit.md.
    `synchronous = NORMAL`: a kill loses nothing, a power cut at most the last moments, and what lies on disk then is
    put right when the service starts.
    """

    def __init__(self, path: Path, folder: DataFolder | None = None) -> None:
        """Raises StoreError, DamagedError for a file that is no database."""
        self._path = path
        self._readers: list[sqlite3.Connection] = []
        self._writing = threading.RLock()
        self.copies = RowCopies()
        """Of the rows that the open transaction changes."""
        self.written = WrittenRows()
        with _as_store_error(path):
            self._writer = _connect(path)
        try:
            with _as_store_error(path):
                self._writer.execute("PRAGMA journal_mode = WAL")
                self._writer.execute("PRAGMA synchronous = NORMAL")
            self._migrate(keep_copy=folder is not None)
        except StoreError:
            self._writer.close()
            raise
        beside: tuple[_CopyOf | None, ...] = (None, None, None)
        if folder is not None:
            beside = (folder.capture_row, folder.reconstruction_row, folder.upload_row)
        self._reserve = None if folder is None else DiskReserve(path.with_name(f"{path.name}-reserve"))
        self.keep_reserve()
        self.captures = Table(self, "captures", CaptureRow, beside[0])
        self.reconstructions = Table(self, "reconstructions", ReconstructionRow, beside[1], NOT_PURGED)
        self.uploads = Table(self, "uploads", UploadRow, beside[2])

    def damage(self) -> str | None:
        """Check the whole file. Return the first problem, None if there is none."""
        try:
            ((found,),) = self.read("PRAGMA integrity_check(1)")
            if found != "ok":
                return str(found).replace("\n", ": ")
            for table in (self.captures, self.reconstructions, self.uploads):
                for row_id, document in table.documents().items():
                    try:
                        table.parse(document)
                    except ValidationError as error:
                        return f"{table.kind} {row_id} cannot be read: {error.errors()[0]['msg']}"
        except DamagedError as error:
            return str(error.__cause__)
        return None

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """The exclusive write connection; committed at the end, rolled back on an exception. Reentrant."""
        with self._writing, _as_store_error(self._path):
            if self._writer.in_transaction:
                yield self._writer
                return
            self._writer.execute("BEGIN IMMEDIATE")
            try:
                yield self._writer
                self.copies.prepare()
                self._writer.execute("COMMIT")
            except BaseException:
                # A full disk may have rolled back by itself.
                with suppress(sqlite3.OperationalError):
                    self._writer.execute("ROLLBACK")
                self.copies.drop()
                raise
            self.copies.place()

    def keep_reserve(self) -> None:
        """Keep some space of the disk for `freeing`, if it is not kept yet and there is room."""
        if self._reserve is not None:
            self._reserve.keep()

    def freeing(self, work: Callable[_Given, _Done], *args: _Given.args, **fields: _Given.kwargs) -> _Done:
        """Do work that leads to more free space. On a full disk it is repeated with the space that is kept for it."""
        try:
            return work(*args, **fields)
        except DamagedError:
            raise
        except StoreError:
            if self._reserve is None or not self._reserve.give_up():
                raise
        return work(*args, **fields)

    def read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """Result of a query on a read-only connection."""
        with _as_store_error(self._path), self._reader() as connection:
            return list(connection.execute(query, values).fetchall())

    def capture_page(
        self,
        limit: int = 50,
        cursor: str | None = None,
        sort: CaptureSort = CaptureSort.STARTED,
        descending: bool = True,
        **wanted: Unpack[CaptureFilter],
    ) -> Page[CaptureRow]:
        """Captures, newest first unless another order is wanted, with the number of all that match.

        Raises UnknownIdError for the cursor of a capture that was purged meanwhile.
        """
        where, values = matching(wanted)
        counted = [*where], [*values]
        key, side, way = SORT_KEYS[sort], "<" if descending else ">", "DESC" if descending else "ASC"
        if cursor is not None:
            last = self.read(f"SELECT {key} FROM capture_list WHERE id = ?", (cursor,))
            if not last and sort is not CaptureSort.STARTED:
                raise UnknownIdError(f"capture {cursor}, after which the list goes on, is gone; list anew")
            where.append(f"(capture_list.{key}, capture_list.id) {side} (?, ?)")
            values += [last[0][0] if last else cursor, cursor]
        found = self.read(
            f"SELECT document FROM capture_list CROSS JOIN captures USING (id) WHERE {' AND '.join(where)} "
            f"ORDER BY capture_list.{key} {way}, capture_list.id {way} LIMIT ?",
            (*values, limit + 1),
        )
        rows = [self.captures.parse(document) for (document,) in found]
        if cursor is None and len(rows) <= limit:
            return Page(rows, None, len(rows))
        total = self._total(*counted, wanted)
        return Page(rows[:limit], rows[limit - 1].id if len(rows) > limit else None, total)

    def _total(self, where: list[str], values: list[Any], wanted: CaptureFilter) -> int:
        """Number of captures that match; one of those that are kept, where these conditions are counted."""
        state, grade, deleted = wanted.get("state"), wanted.get("grade"), bool(wanted.get("deleted"))
        if len(where) == 1 + sum(one is not None for one in (state, grade)):
            query = "SELECT coalesce(sum(captures), 0) FROM capture_counts WHERE deleted = ?1"
            ((total,),) = self.read(
                f"{query} AND state = coalesce(?2, state) AND grade = coalesce(?3, grade)",
                (deleted, state and str(state), grade and str(grade)),
            )
        else:
            ((total,),) = self.read(f"SELECT count(*) FROM capture_list WHERE {' AND '.join(where)}", tuple(values))
        return int(total)

    def capture_counts(self) -> dict[str, int]:
        """Number of captures by state, without removed ones."""
        found = self.read("SELECT state, sum(captures) FROM capture_counts WHERE NOT deleted GROUP BY state")
        return dict.fromkeys(map(str, CaptureState), 0) | dict(found)

    def grade_counts(self) -> dict[str, int]:
        """Number of captures by the grade of their recordings, without removed ones and those that have none."""
        graded = "NOT deleted AND grade <> ''"
        found = self.read(f"SELECT grade, sum(captures) FROM capture_counts WHERE {graded} GROUP BY grade")
        return dict.fromkeys(map(str, Grade), 0) | dict(found)

    def reconstruction_page(
        self, limit: int = 50, cursor: str | None = None, capture_id: str | None = None, state: JobState | None = None
    ) -> Page[ReconstructionRow]:
        """Reconstructions, newest first."""
        wanted = {"capture_id = ?": capture_id, "state = ?": state and str(state), "id < ?": cursor}
        given = {condition: value for condition, value in wanted.items() if value is not None}
        where = " AND ".join(f"jobs.{condition}" for condition in (NOT_PURGED, *given))
        found = self.read(
            f"SELECT document FROM jobs CROSS JOIN reconstructions USING (id) WHERE {where} "
            "ORDER BY jobs.id DESC LIMIT ?",
            (*given.values(), limit + 1),
        )
        rows = [self.reconstructions.parse(document) for (document,) in found]
        return Page(rows[:limit], rows[limit - 1].id if len(rows) > limit else None)

    def job_counts(self, capture_id: str = "") -> dict[JobState, int]:
        """Number of reconstructions by state, of a capture or of all."""
        found = self.read(f"SELECT state, jobs FROM job_counts WHERE capture_id = ? AND {NOT_PURGED}", (capture_id,))
        counts = dict.fromkeys(JobState, 0) | {JobState(state): count for state, count in found}
        if not capture_id:
            gone = "SELECT state, sum(jobs) FROM purges CROSS JOIN job_counts USING (capture_id) GROUP BY state"
            for state, count in self.read(gone):
                counts[JobState(state)] -= count
        return counts

    def job_ids(self, capture_id: str, limit: int, state: JobState | None = None) -> list[str]:
        """Ids of the newest reconstructions of a capture, the newest first."""
        where, values = ("", ()) if state is None else (" AND state = ?", (str(state),))
        query = f"SELECT id FROM jobs WHERE capture_id = ? AND {NOT_PURGED}{where} ORDER BY id DESC LIMIT ?"
        return [row_id for (row_id,) in self.read(query, (capture_id, *values, limit))]

    def newest_jobs(self, capture_ids: Sequence[str], limit: int) -> list[tuple[tuple[str, ...], int]]:
        """Of each capture the ids of its newest reconstructions, the newest first, and how many there are."""
        found = self.read(_NEWEST_JOBS, (limit, json.dumps(capture_ids)))
        known = {one: (tuple(ids.split(",")) if ids else (), count) for one, ids, count in found}
        return [known[one] for one in capture_ids]

    def shown_job(self, capture_id: str) -> str | None:
        """Id of the newest reconstruction of a capture that has a version, else of the newest that may get one."""
        wanted = f"capture_id = ? AND {NOT_PURGED} AND worth > 0"
        query = f"SELECT id FROM jobs WHERE {wanted} ORDER BY worth DESC, id DESC LIMIT 1"
        found = self.read(query, (capture_id,))
        return found[0][0] if found else None

    def captures_to_clear(self) -> list[str]:
        """Ids of the removed captures with reconstructions that wait."""
        removed = "SELECT id FROM captures WHERE deleted_at IS NOT NULL"
        if not any(deleted for (deleted,) in self.read("SELECT deleted FROM capture_counts WHERE captures > 0")):
            return []
        waiting = "SELECT capture_id FROM job_counts WHERE state = ? AND jobs > 0"
        return [row_id for (row_id,) in self.read(f"{removed} INTERSECT {waiting}", (str(JobState.QUEUED),))]

    def ended_reconstructions(self) -> list[str]:
        """Ids of the reconstructions that have ended."""
        over = tuple(str(state) for state in JobState if state.over)
        found = self.read(f"SELECT id FROM jobs WHERE state IN ({', '.join('?' * len(over))}) AND {NOT_PURGED}", over)
        return [row_id for (row_id,) in found]

    def lost_reconstructions(self) -> list[str]:
        """Ids of the reconstructions whose capture is missing."""
        counted = f"SELECT capture_id FROM job_counts WHERE capture_id <> '' AND {NOT_PURGED}"
        lost = f"capture_id IN ({counted} EXCEPT SELECT id FROM captures)"
        return [row_id for (row_id,) in self.read(f"SELECT id FROM jobs WHERE {lost}")]

    def put_version(self, row: VersionRow, kept: set[int]) -> None:
        """Save a version and delete those that are not kept."""
        with self.transaction() as connection:
            connection.execute(
                "INSERT OR REPLACE INTO versions VALUES (?, ?, ?)",
                (row.reconstruction_id, row.version, _VERSION.dump_json(row).decode()),
            )
            for (number,) in connection.execute(
                "SELECT version FROM versions WHERE reconstruction_id = ?", (row.reconstruction_id,)
            ).fetchall():
                if number not in kept:
                    connection.execute(
                        "DELETE FROM versions WHERE reconstruction_id = ? AND version = ?",
                        (row.reconstruction_id, number),
                    )

    def versions(self, reconstruction_id: str) -> list[VersionRow]:
        """The available versions of a reconstruction, oldest first."""
        found = self.read(
            "SELECT document FROM versions WHERE reconstruction_id = ? ORDER BY version", (reconstruction_id,)
        )
        return [_VERSION.validate_json(document) for (document,) in found]

    def version_numbers(self, reconstruction_id: str) -> set[int]:
        """Numbers of the available versions of a reconstruction."""
        found = self.read("SELECT version FROM versions WHERE reconstruction_id = ?", (reconstruction_id,))
        return {number for (number,) in found}

    def forget_versions(self, reconstruction_id: str) -> None:
        """Delete the versions of a reconstruction."""
        with self.transaction() as connection:
            connection.execute("DELETE FROM versions WHERE reconstruction_id = ?", (reconstruction_id,))

    def remove_jobs(self, ids: Sequence[str]) -> None:
        """Delete reconstructions with their versions, in one transaction."""
        marks = ", ".join("?" * len(ids))
        with self.transaction() as connection:
            self.written.note(*ids)
            connection.execute(f"DELETE FROM versions WHERE reconstruction_id IN ({marks})", tuple(ids))
            connection.execute(f"DELETE FROM reconstructions WHERE id IN ({marks})", tuple(ids))

    @contextmanager
    def _reader(self) -> Iterator[sqlite3.Connection]:
        """One that nobody uses just now, or a new one: as many as ever read at the same time.

        Not one for each thread: threads come and go with requests, and a connection, which Python's sqlite3 makes part
        of a cycle, would hold its files until the garbage collector comes to it.
        """
        try:
            connection = self._readers.pop()
        except IndexError:
            connection = _connect(self._path)
            connection.execute("PRAGMA query_only = ON")
        try:
            yield connection
        except BaseException:
            connection.close()
            raise
        self._readers.append(connection)

    def close(self) -> None:
        """Write the log back into the file and close it."""
        while self._readers:
            self._readers.pop().close()
        with self._writing:
            with suppress(sqlite3.Error):
                self._writer.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._writer.close()

    def _migrate(self, keep_copy: bool) -> None:
        with _as_store_error(self._path):
            schema = schema_of(self._writer)
            if schema > len(MIGRATIONS):
                writer = written_by(self._writer)
                raise StoreError(
                    f"{self._path} was written by a newer spiked{f' ({writer})' if writer else ''}, "
                    f"with schema {schema} of the catalogue; this one knows {len(MIGRATIONS)}: use that "
                    "release or a later one, or another data folder"
                )
            if keep_copy:
                copy_before_migration(self._writer, self._path)
        with self.transaction() as connection:
            migrate(connection)


class Table(Generic[_Row]):
    """A table of rows by id."""

    def __init__(
        self, catalogue: Catalogue, name: str, kind: type[_Row], beside: _CopyOf | None = None, there: str = "1"
    ) -> None:
        """`beside` returns the path of the copy of a row, which is written if its folder exists; `there` is an SQL
        condition: other rows are not found by their ids.
        """
        self._catalogue = catalogue
        self._name = name
        self._kind: TypeAdapter[_Row] = TypeAdapter(kind)
        self._beside = beside
        self._of_id = f"SELECT document FROM {name} WHERE id = ? AND {there}"

    @property
    def kind(self) -> str:
        """Name of the kind of row, for messages."""
        return self._name.removesuffix("s")

    def put(self, row: _Row) -> None:
        """Insert a row, or replace the one with its id."""
        document = self._kind.dump_json(row)
        with self._catalogue.transaction() as connection:
            self._catalogue.written.note(row.id)
            connection.execute(
                f"INSERT OR REPLACE INTO {self._name} (id, document) VALUES (?, ?)", (row.id, document.decode())
            )
            if self._beside is not None:
                self._catalogue.copies.put(self._beside(row.id), document)

    def documents(self) -> dict[str, str]:
        """All rows as they are stored, by id."""
        return dict(self._catalogue.read(f"SELECT id, document FROM {self._name}"))

    def parse(self, document: str | bytes) -> _Row:
        """The row of a document. Raises pydantic's ValidationError."""
        return self._kind.validate_json(document)

    def find(self, row_id: str) -> _Row | None:
        """The row, or None."""
        found = self._catalogue.read(self._of_id, (row_id,))
        return self._kind.validate_json(found[0][0]) if found else None

    def get(self, row_id: str) -> _Row:
        """The row. Raises UnknownIdError."""
        row = self.find(row_id)
        if row is None:
            raise UnknownIdError(f"there is no {self.kind} {row_id}; GET {self._name} lists them")
        return row

    def change(self, row_id: str, change: Callable[[_Row], _Row]) -> _Row:
        """Replace a row by what `change` makes of it, with no other writer in between. Raises UnknownIdError."""
        with self._catalogue.transaction():
            before = self.get_for_change(row_id)
            after = change(before)
            if after != before:
                self.put(after)
            return after

    def set(self, row_id: str, **fields: Any) -> _Row:
        """Replace fields of a row. Raises UnknownIdError."""
        return self.change(row_id, lambda row: replace(row, **fields))  # type: ignore[type-var]

    def get_for_change(self, row_id: str) -> _Row:
        """The row as the open transaction sees it. Raises UnknownIdError."""
        with self._catalogue.transaction() as connection:
            found = connection.execute(self._of_id, (row_id,)).fetchone()
        if found is None:
            raise UnknownIdError(f"there is no {self.kind} {row_id}; GET {self._name} lists them")
        return self._kind.validate_json(found[0])

    def remove(self, row_id: str) -> None:
        """Delete a row and its copy, if they exist."""
        with self._catalogue.transaction() as connection:
            self._catalogue.written.note(row_id)
            connection.execute(f"DELETE FROM {self._name} WHERE id = ?", (row_id,))
            if self._beside is not None:
                self._catalogue.copies.remove(self._beside(row_id))

    def where(self, condition: str = "1", values: tuple[Any, ...] = ()) -> list[_Row]:
        """Rows that match an SQL condition, which may include ORDER BY."""
        found = self._catalogue.read(f"SELECT document FROM {self._name} WHERE {condition}", values)
        return [self._kind.validate_json(document) for (document,) in found]


_VERSION = TypeAdapter(VersionRow)


def _connect(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(path, timeout=_WAIT_S, isolation_level=None, check_same_thread=False)


@contextmanager
def _as_store_error(path: Path) -> Iterator[None]:
    try:
        yield
    except (sqlite3.DatabaseError, OSError) as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        kind = DamagedError if code in _DAMAGED else StoreError
        raise kind(f"the catalogue {path} cannot be used: {error}; look whether its disk is full or broken") from error
