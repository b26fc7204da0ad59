"""Which captures are listed, and in what order, in SQL."""

import json
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
    CaptureSort.NAME: "name",
    CaptureSort.LENGTH: "length",
    CaptureSort.SIZE: "bytes",
    CaptureSort.VERDICT: "verdict",
    CaptureSort.RECONSTRUCTION: "job",
}
"""Columns of `capture_list`, each with an index; captures that are alike in them are ordered by id."""


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
    """SQL conditions on `capture_list` for a list of captures, and their values."""
    conditions: dict[str, Any] = {"capture_list.deleted = ?": int(bool(wanted.get("deleted")))}
    for key, column in (("state", "state"), ("grade", "grade"), ("group", "group_id"), ("keep", "keep")):
        if (value := wanted.get(key)) is not None:
            conditions[f"capture_list.{column} = ?"] = int(value) if isinstance(value, bool) else str(value)
    if (tag := wanted.get("tag")) is not None:
        # As JSON has it within a list: quotes of a tag are escaped, so that none contains another in its quotes.
        conditions["instr(capture_list.tags, ?)"] = json.dumps(tag, ensure_ascii=False)
    if query := wanted.get("query"):
        text = "SELECT text FROM capture_texts WHERE capture_texts.id = capture_list.id"
        conditions[f"instr(({text}), ?)"] = str(query).lower()
    return list(conditions), list(conditions.values())
