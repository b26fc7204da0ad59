"""Which captures are listed, and in what order, in SQL."""

from enum import StrEnum
from typing import Any, TypedDict

from spiked_service.store.rows import CaptureState, Grade


class CaptureSort(StrEnum):
    """By what captures are listed."""

    STARTED = "started"
    NAME = "name"
    """Or the source of those without."""
    LENGTH = "length"
    SIZE = "size"
    VERDICT = "verdict"
    """None, bad, degraded, good."""
    RECONSTRUCTION = "reconstruction"
    """State of the newest one; none first."""


SORT_KEYS = {
    CaptureSort.STARTED: "id",
    CaptureSort.NAME: "lower(coalesce(nullif(json_extract(document, '$.name'), ''), "
    "json_extract(document, '$.plan.source')))",
    CaptureSort.LENGTH: "coalesce(json_extract(document, '$.recording.frames') * 1.0 / "
    "json_extract(document, '$.sensor.frame_rate_hz'), 0)",
    CaptureSort.SIZE: "coalesce(json_extract(document, '$.recording.bytes'), 0)",
    CaptureSort.VERDICT: "CASE json_extract(document, '$.verdict.grade') "
    "WHEN 'good' THEN 3 WHEN 'degraded' THEN 2 WHEN 'bad' THEN 1 ELSE 0 END",
    CaptureSort.RECONSTRUCTION: "coalesce((SELECT state FROM jobs WHERE capture_id = captures.id "
    "ORDER BY jobs.id DESC LIMIT 1), '')",
}
"""SQL expressions, never null; captures that are alike in them are ordered by id."""


class CaptureFilter(TypedDict, total=False):
    """Which captures are listed; None and what is left out: any."""

    query: str | None
    """Looked for in name, notes, source, tags and metadata."""
    state: CaptureState | None
    deleted: bool
    """Those that were removed, instead of the others."""
    group: str | None
    tag: str | None
    grade: Grade | None
    keep: bool | None


def matching(wanted: CaptureFilter) -> tuple[list[str], list[Any]]:
    """SQL conditions for a list of captures, and their values."""
    state, group, tag, query = (wanted.get(key) for key in ("state", "group", "tag", "query"))
    where, values = ["deleted_at IS NOT NULL" if wanted.get("deleted") else "deleted_at IS NULL"], list[Any]()
    if state is not None:
        where.append("state = ?")
        values.append(str(state))
    if group is not None:
        where.append("json_extract(document, '$.group') = ?")
        values.append(group)
    if tag is not None:
        where.append("EXISTS (SELECT 1 FROM json_each(document, '$.tags') WHERE value = ?)")
        values.append(tag)
    if (grade := wanted.get("grade")) is not None:
        where.append("json_extract(document, '$.verdict.grade') = ?")
        values.append(str(grade))
    if (keep := wanted.get("keep")) is not None:
        where.append("coalesce(json_extract(document, '$.keep'), 0) = ?")
        values.append(int(keep))
    if query:
        fields = ("$.name", "$.notes", "$.plan.source", "$.tags", "$.metadata")
        where.append("(" + " OR ".join(f"instr(lower(json_extract(document, '{f}')), ?)" for f in fields) + ")")
        values += [str(query).lower()] * len(fields)
    return where, values
