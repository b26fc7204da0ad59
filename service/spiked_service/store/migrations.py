"""The schemas of the catalogue, and how a file of an earlier one becomes one of today."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from spiked_service.base.version import installed_version

MIGRATIONS = (
    """
    CREATE TABLE captures (
        id TEXT PRIMARY KEY, document TEXT NOT NULL,
        state TEXT GENERATED ALWAYS AS (json_extract(document, '$.state')) VIRTUAL,
        deleted_at TEXT GENERATED ALWAYS AS (json_extract(document, '$.deleted_at')) VIRTUAL
    ) WITHOUT ROWID;
    CREATE INDEX captures_by_state ON captures (state);
    CREATE TABLE reconstructions (
        id TEXT PRIMARY KEY, document TEXT NOT NULL,
        capture_id TEXT GENERATED ALWAYS AS (json_extract(document, '$.capture_id')) VIRTUAL,
        state TEXT GENERATED ALWAYS AS (json_extract(document, '$.state')) VIRTUAL,
        priority INTEGER GENERATED ALWAYS AS (json_extract(document, '$.priority')) VIRTUAL
    ) WITHOUT ROWID;
    CREATE INDEX reconstructions_by_capture ON reconstructions (capture_id);
    CREATE INDEX reconstructions_by_state ON reconstructions (state, priority);
    CREATE TABLE uploads (id TEXT PRIMARY KEY, document TEXT NOT NULL) WITHOUT ROWID;
    CREATE TABLE versions (
        reconstruction_id TEXT NOT NULL, version INTEGER NOT NULL, document TEXT NOT NULL,
        PRIMARY KEY (reconstruction_id, version)
    ) WITHOUT ROWID;
    """,
    """
    CREATE TABLE history (schema INTEGER PRIMARY KEY, at TEXT NOT NULL, program TEXT NOT NULL);
    CREATE INDEX captures_by_group ON captures (json_extract(document, '$.group'));
    CREATE INDEX reconstructions_by_state_and_age ON reconstructions (state, id);
    """,
    """
    CREATE TABLE queue (
        urgency INTEGER NOT NULL, turn TEXT NOT NULL, id TEXT NOT NULL UNIQUE, held INTEGER NOT NULL,
        user TEXT NOT NULL, PRIMARY KEY (urgency, turn, id)
    ) WITHOUT ROWID;
    CREATE INDEX queue_by_user ON queue (urgency, user, turn);
    CREATE TRIGGER queue_follows AFTER INSERT ON reconstructions BEGIN
        DELETE FROM queue WHERE id = NEW.id;
        INSERT INTO queue SELECT -coalesce(json_extract(NEW.document, '$.priority'), 0),
            coalesce(nullif(json_extract(NEW.document, '$.turn'), ''), NEW.id), NEW.id,
            coalesce(json_extract(NEW.document, '$.held'), 0), coalesce(json_extract(NEW.document, '$.user'), '')
            WHERE json_extract(NEW.document, '$.state') = 'queued';
    END;
    CREATE TRIGGER queue_forgets AFTER DELETE ON reconstructions BEGIN
        DELETE FROM queue WHERE id = OLD.id;
    END;
    INSERT INTO queue SELECT -coalesce(json_extract(document, '$.priority'), 0),
        coalesce(nullif(json_extract(document, '$.turn'), ''), id), id, coalesce(json_extract(document, '$.held'), 0),
        ''
        FROM reconstructions WHERE state = 'queued';
    """,
)
"""Script n migrates a catalogue from schema n to n + 1; the schema is the file's user_version.

A script that has been released is never changed. Every schema from the second on keeps the table `history`, so that a
release that does not know a schema can name the one that wrote it. `tests/service/store/schemas` holds a catalogue of
each former one. The table `queue` holds the order of the queued reconstructions, which are written by INSERT OR REPLACE
only: real columns, because SQLite reads a row's document for a column that is made of it, index or not.
"""


def schema_of(connection: sqlite3.Connection) -> int:
    """The schema of a catalogue; 0 for an empty file."""
    ((schema,),) = connection.execute("PRAGMA user_version").fetchall()
    return int(schema)


def written_by(connection: sqlite3.Connection) -> str | None:
    """The version of spiked that wrote the schema; None where that is not known."""
    try:
        found = connection.execute("SELECT program FROM history ORDER BY schema DESC LIMIT 1").fetchall()
    except sqlite3.OperationalError:
        return None
    return str(found[0][0]) if found else None


def copy_before_migration(connection: sqlite3.Connection, path: Path) -> Path | None:
    """Copy a catalogue of an earlier schema into `backups` beside it, which the release that wrote it can restore.

    Returns the copy, None if there is nothing to migrate. Raises sqlite3.Error and OSError.
    """
    schema = schema_of(connection)
    if not 0 < schema < len(MIGRATIONS):
        return None
    folder = path.parent / "backups"
    folder.mkdir(mode=0o700, exist_ok=True)
    target = folder / f"schema-{schema}-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.sqlite"
    with closing(sqlite3.connect(target)) as copy:
        connection.backup(copy)
    return target


def _statements(script: str) -> Iterator[str]:
    """The statements of a script; a trigger is one with those inside of it."""
    statement = ""
    for part in script.split(";"):
        statement += f"{part};"
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""


def migrate(connection: sqlite3.Connection) -> None:
    """Apply the scripts that a catalogue lacks, within the open transaction, and note which release did it."""
    before = schema_of(connection)
    for number in range(before, len(MIGRATIONS)):
        for statement in _statements(MIGRATIONS[number]):
            connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {number + 1}")
    if before < len(MIGRATIONS):
        connection.execute(
            "INSERT INTO history VALUES (?, ?, ?)",
            (len(MIGRATIONS), datetime.now(UTC).isoformat(), installed_version()),
        )
