"""What localising, extending and merging found, and which recording a result is of, as JSON."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from pydantic import TypeAdapter

from spiked.recording import Recording, RecordingGeometry
from spiked.whole_files import write_atomically

LOCALISATION, REGISTRATION, REPORT = "localisation.json", "registration.json", "report.json"
"""Names of the files in the folder of a job."""
RUN = "run"
"""Key of report.json, and of the parameters in a checkpoint: what tells a run from others in the same folder."""
_GEOMETRY = TypeAdapter(RecordingGeometry)


def recording_section(recording: Recording) -> dict[str, object]:
    """The part of report.json that says where a recording is, and how its bytes were read."""
    geometry = RecordingGeometry(
        **{part.name: getattr(recording.sensor, part.name) for part in fields(RecordingGeometry)}
    )
    place = recording.path.absolute()
    return {
        "file": place.name,
        "folder": str(place.parent),
        "geometry": _GEOMETRY.dump_python(geometry, mode="json"),
    }


def recorded_geometry(section: Mapping[str, object]) -> RecordingGeometry:
    """The geometry of a `recording_section`. Raises ValueError."""
    return _GEOMETRY.validate_python(section.get("geometry") or {})


def write_report(folder: Path, name: str, figures: Mapping[str, object]) -> None:
    """Raises OSError."""
    write_atomically(folder / name, json.dumps(figures).encode())
