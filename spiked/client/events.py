"""Messages of the service, as server-sent events."""

import json
from collections.abc import Iterable, Iterator
from datetime import datetime
from typing import Any

from pydantic import BaseModel


class Event(BaseModel):
    """One message; `data` has the fields that docs/events.md lists for its topic."""

    seq: int
    """One more than that of the message before, of whatever topic."""
    topic: str
    """device, capture, job, pose, scene, preview, log or lost."""
    at: datetime
    capture_id: str | None = None
    reconstruction_id: str | None = None
    data: dict[str, Any]


def events_in(lines: Iterable[str]) -> Iterator[Event]:
    """The events of a stream of lines (HTML standard, 9.2); comments keep it alive."""
    parts: list[str] = []
    for line in lines:
        if line.startswith("data:"):
            parts.append(line[5:].removeprefix(" "))
        elif not line and parts:
            yield Event.model_validate(json.loads("\n".join(parts)))
            parts.clear()
