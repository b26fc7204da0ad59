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
    """
    DROP INDEX reconstructions_by_capture;
    DROP INDEX reconstructions_by_state;
    DROP INDEX reconstructions_by_state_and_age;
    DROP TRIGGER queue_follows;
    CREATE TABLE jobs (
        capture_id TEXT NOT NULL, id TEXT NOT NULL UNIQUE, state TEXT NOT NULL, worth INTEGER NOT NULL,
        PRIMARY KEY (capture_id, id)
    ) WITHOUT ROWID;
    CREATE INDEX jobs_by_state ON jobs (state, id);
    CREATE INDEX jobs_of_capture_by_state ON jobs (capture_id, state, id);
    CREATE INDEX jobs_by_worth ON jobs (capture_id, worth, id);
    CREATE TABLE job_counts (
        capture_id TEXT NOT NULL, state TEXT NOT NULL, jobs INTEGER NOT NULL, PRIMARY KEY (capture_id, state)
    ) WITHOUT ROWID;
    CREATE TRIGGER jobs_counted AFTER INSERT ON jobs BEGIN
        INSERT INTO job_counts VALUES (NEW.capture_id, NEW.state, 1), ('', NEW.state, 1)
            ON CONFLICT DO UPDATE SET jobs = jobs + 1;
    END;
    CREATE TRIGGER jobs_recounted AFTER UPDATE OF state ON jobs BEGIN
        UPDATE job_counts SET jobs = jobs - 1 WHERE capture_id IN (OLD.capture_id, '') AND state = OLD.state;
        INSERT INTO job_counts VALUES (NEW.capture_id, NEW.state, 1), ('', NEW.state, 1)
            ON CONFLICT DO UPDATE SET jobs = jobs + 1;
    END;
    CREATE TRIGGER jobs_discounted AFTER DELETE ON jobs BEGIN
        UPDATE job_counts SET jobs = jobs - 1 WHERE capture_id IN (OLD.capture_id, '') AND state = OLD.state;
        DELETE FROM job_counts WHERE capture_id = OLD.capture_id AND jobs = 0;
    END;
    CREATE TRIGGER jobs_follow AFTER INSERT ON reconstructions BEGIN
        INSERT INTO jobs SELECT json_extract(NEW.document, '$.capture_id'), NEW.id,
            json_extract(NEW.document, '$.state'),
            CASE WHEN json_extract(NEW.document, '$.task') = 'localise' THEN 0
                WHEN json_extract(NEW.document, '$.version') > 0 THEN 2 ELSE 1 END
            WHERE true ON CONFLICT (id) DO UPDATE SET state = excluded.state, worth = excluded.worth
            WHERE state <> excluded.state OR worth <> excluded.worth;
    END;
    CREATE TRIGGER jobs_forget AFTER DELETE ON reconstructions BEGIN
        DELETE FROM jobs WHERE id = OLD.id;
    END;
    INSERT INTO jobs SELECT json_extract(document, '$.capture_id'), id, json_extract(document, '$.state'),
        CASE WHEN json_extract(document, '$.task') = 'localise' THEN 0
            WHEN json_extract(document, '$.version') > 0 THEN 2 ELSE 1 END
        FROM reconstructions;
    ALTER TABLE queue ADD COLUMN recording TEXT NOT NULL DEFAULT '';
    UPDATE queue SET recording = coalesce((SELECT json_extract(document, '$.capture_id') FROM reconstructions
        WHERE reconstructions.id = queue.id AND coalesce(json_extract(document, '$.task'), '') <> 'merge'), '');
    CREATE INDEX queue_released ON queue (urgency, turn, id, recording) WHERE NOT held;
    CREATE TABLE queue_blocks (
        digits INTEGER NOT NULL, urgency INTEGER NOT NULL, block TEXT NOT NULL, jobs INTEGER NOT NULL,
        PRIMARY KEY (digits, urgency, block)
    ) WITHOUT ROWID;
    CREATE TRIGGER queue_counted AFTER INSERT ON queue BEGIN
        INSERT INTO queue_blocks SELECT column1, NEW.urgency, substr(NEW.turn, 1, column1), 1
            FROM (VALUES (6), (8), (11), (13)) WHERE true ON CONFLICT DO UPDATE SET jobs = jobs + 1;
    END;
    CREATE TRIGGER queue_discounted AFTER DELETE ON queue BEGIN
        INSERT INTO queue_blocks SELECT column1, OLD.urgency, substr(OLD.turn, 1, column1), 0
            FROM (VALUES (6), (8), (11), (13)) WHERE true ON CONFLICT DO UPDATE SET jobs = jobs - 1;
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 6 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 6);
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 8 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 8);
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 11 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 11);
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 13 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 13);
    END;
    INSERT INTO queue_blocks SELECT column1, urgency, substr(turn, 1, column1), count(*)
        FROM queue JOIN (VALUES (6), (8), (11), (13)) GROUP BY 1, 2, 3;
    CREATE TRIGGER queue_follows AFTER INSERT ON reconstructions BEGIN
        DELETE FROM queue WHERE id = NEW.id;
        INSERT INTO queue SELECT -coalesce(json_extract(NEW.document, '$.priority'), 0),
            coalesce(nullif(json_extract(NEW.document, '$.turn'), ''), NEW.id), NEW.id,
            coalesce(json_extract(NEW.document, '$.held'), 0), coalesce(json_extract(NEW.document, '$.user'), ''),
            iif(json_extract(NEW.document, '$.task') = 'merge', '', json_extract(NEW.document, '$.capture_id'))
            WHERE json_extract(NEW.document, '$.state') = 'queued';
    END;
    CREATE TABLE capture_counts (
        deleted INTEGER NOT NULL, state TEXT NOT NULL, grade TEXT NOT NULL, captures INTEGER NOT NULL,
        PRIMARY KEY (deleted, state, grade)
    ) WITHOUT ROWID;
    INSERT INTO capture_counts SELECT json_extract(document, '$.deleted_at') IS NOT NULL,
        json_extract(document, '$.state'), coalesce(json_extract(document, '$.verdict.grade'), ''), count(*)
        FROM captures GROUP BY 1, 2, 3;
    CREATE TRIGGER captures_replaced BEFORE INSERT ON captures BEGIN
        UPDATE capture_counts SET captures = captures - 1 WHERE (deleted, state, grade) IN
            (SELECT json_extract(document, '$.deleted_at') IS NOT NULL, json_extract(document, '$.state'),
                coalesce(json_extract(document, '$.verdict.grade'), '') FROM captures WHERE id = NEW.id);
    END;
    CREATE TRIGGER captures_counted AFTER INSERT ON captures BEGIN
        INSERT INTO capture_counts VALUES (json_extract(NEW.document, '$.deleted_at') IS NOT NULL,
            json_extract(NEW.document, '$.state'), coalesce(json_extract(NEW.document, '$.verdict.grade'), ''), 1)
            ON CONFLICT DO UPDATE SET captures = captures + 1;
    END;
    CREATE TRIGGER captures_discounted AFTER DELETE ON captures BEGIN
        UPDATE capture_counts SET captures = captures - 1 WHERE deleted = (OLD.deleted_at IS NOT NULL)
            AND state = OLD.state AND grade = coalesce(json_extract(OLD.document, '$.verdict.grade'), '');
    END;
    """,
    """
    CREATE TABLE purges (capture_id TEXT PRIMARY KEY) WITHOUT ROWID;
    DROP INDEX captures_by_state;
    DROP INDEX captures_by_group;
    CREATE TABLE capture_list (
        id TEXT PRIMARY KEY, deleted INTEGER NOT NULL, since INTEGER NOT NULL, state TEXT NOT NULL,
        grade TEXT NOT NULL, keep INTEGER NOT NULL, group_id TEXT NOT NULL, tags TEXT NOT NULL, name TEXT NOT NULL,
        length REAL NOT NULL, bytes INTEGER NOT NULL, verdict INTEGER NOT NULL, job TEXT NOT NULL
    ) WITHOUT ROWID;
    CREATE INDEX captures_listed ON capture_list (deleted, id);
    CREATE INDEX captures_by_age ON capture_list (deleted, since);
    CREATE INDEX captures_by_group ON capture_list (group_id) WHERE group_id <> '';
    CREATE INDEX captures_by_name ON capture_list (deleted, name, id);
    CREATE INDEX captures_by_length ON capture_list (deleted, length, id);
    CREATE INDEX captures_by_bytes ON capture_list (deleted, bytes, id);
    CREATE INDEX captures_by_verdict ON capture_list (deleted, verdict, id);
    CREATE INDEX captures_by_job ON capture_list (deleted, job, id);
    CREATE TABLE capture_texts (id TEXT PRIMARY KEY, text TEXT NOT NULL) WITHOUT ROWID;
    CREATE TRIGGER captures_follow AFTER INSERT ON captures BEGIN
        INSERT OR REPLACE INTO capture_list SELECT NEW.id, NEW.deleted_at IS NOT NULL,
            coalesce(CAST(strftime('%s', coalesce(NEW.deleted_at, json_extract(NEW.document, '$.ended_at'),
                json_extract(NEW.document, '$.started_at'))) AS INTEGER), 0),
            NEW.state, coalesce(json_extract(NEW.document, '$.verdict.grade'), ''),
            coalesce(json_extract(NEW.document, '$.keep'), 0), coalesce(json_extract(NEW.document, '$.group'), ''),
            coalesce(json_extract(NEW.document, '$.tags'), '[]'),
            lower(coalesce(nullif(json_extract(NEW.document, '$.name'), ''),
                json_extract(NEW.document, '$.plan.source'), '')),
            coalesce(json_extract(NEW.document, '$.recording.frames') * 1.0
                / json_extract(NEW.document, '$.sensor.frame_rate_hz'), 0),
            coalesce(json_extract(NEW.document, '$.recording.bytes'), 0),
            CASE json_extract(NEW.document, '$.verdict.grade')
                WHEN 'good' THEN 3 WHEN 'degraded' THEN 2 WHEN 'bad' THEN 1 ELSE 0 END,
            coalesce((SELECT state FROM jobs WHERE capture_id = NEW.id ORDER BY id DESC LIMIT 1), '');
        INSERT OR REPLACE INTO capture_texts SELECT NEW.id, lower(coalesce(json_extract(NEW.document, '$.name'), '')
            || char(31) || coalesce(json_extract(NEW.document, '$.notes'), '')
            || char(31) || coalesce(json_extract(NEW.document, '$.plan.source'), '')
            || char(31) || coalesce(json_extract(NEW.document, '$.tags'), '')
            || char(31) || coalesce(json_extract(NEW.document, '$.metadata'), ''));
    END;
    CREATE TRIGGER captures_forget AFTER DELETE ON captures BEGIN
        DELETE FROM capture_list WHERE id = OLD.id;
        DELETE FROM capture_texts WHERE id = OLD.id;
    END;
    CREATE TRIGGER jobs_listed AFTER INSERT ON jobs BEGIN
        UPDATE capture_list SET job = NEW.state WHERE id = NEW.capture_id
            AND NOT EXISTS (SELECT 1 FROM jobs WHERE capture_id = NEW.capture_id AND id > NEW.id);
    END;
    CREATE TRIGGER jobs_relisted AFTER UPDATE OF state ON jobs BEGIN
        UPDATE capture_list SET job = NEW.state WHERE id = NEW.capture_id
            AND NOT EXISTS (SELECT 1 FROM jobs WHERE capture_id = NEW.capture_id AND id > NEW.id);
    END;
    CREATE TRIGGER jobs_unlisted AFTER DELETE ON jobs BEGIN
        UPDATE capture_list
            SET job = coalesce((SELECT state FROM jobs WHERE capture_id = OLD.capture_id ORDER BY id DESC LIMIT 1), '')
            WHERE id = OLD.capture_id
            AND NOT EXISTS (SELECT 1 FROM jobs WHERE capture_id = OLD.capture_id AND id > OLD.id);
    END;
    INSERT OR REPLACE INTO captures (id, document) SELECT id, document FROM captures;
    """,
)
"""Script n migrates a catalogue from schema n to n + 1; the schema is the file's user_version.

A script that has been released is never changed. Every schema from the second on keeps the table `history`, so that a
release that does not know a schema can name the one that wrote it. `tests/service/store/schemas` holds a catalogue of
each former one. Reconstructions and captures are written by INSERT OR REPLACE only, and triggers keep tables of real
columns in step with them, because SQLite reads a row's document for a column that is made of it, index or not:

* `queue`: the order of the queued reconstructions, and the captures whose recordings they read
* `queue_blocks`: how many of them have the same first digits of their turns, which an id's time begins, so that a place
  is the sum of few rows
* `jobs`: states and captures of all reconstructions, and what they are worth as the scene of their capture: 0 for a
  localisation, 1 without a version, 2 with one
* `job_counts`: how many jobs there are, of each capture and of all (''); `capture_counts`: how many captures
* `capture_list`: what captures are sorted and filtered by, with the state of their newest job; `since` is when one was
  removed, else when it ended, in Unix seconds; `capture_texts`: the lower-case text that is searched

`purges` has the captures that were deleted for good and whose jobs are being deleted: reading passes over these.
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
