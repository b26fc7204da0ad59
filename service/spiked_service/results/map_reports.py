"""What localising, extending and merging found, and which recording a result is of, as JSON."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from spiked.recon import Localisation
from spiked.recording import Recording, RecordingGeometry
from spiked.sensor import Sensor
from spiked.whole_files import write_atomically
from spiked_service.results.timeline import frames_at

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


def localisation_figures(found: Localisation, sensor: Sensor) -> dict[str, object]:
    """All figures of a localisation."""
    frames = frames_at(np.array([sensor.seconds(view.time) for view in found.views]), sensor.frame_rate_hz)
    views = [
        {
            "frame": int(frame),
            "time_s": sensor.seconds(view.time),
            "rotation": _rounded(view.pose.rotation),
            "position": _rounded(view.pose.centre),
            "inliers": view.fit.inliers,
            "inlier_share": round(view.fit.share, 4),
            "correlation": round(view.correlation, 4),
            "sigma": round(view.fit.sigma, 9),
            "sigma_px": round(view.fit.sigma_px, 4),
        }
        for frame, view in zip(frames, found.views, strict=True)
    ]
    return {
        "recognised": found.recognised,
        "reason": found.reason,
        "searches": found.searches,
        "agreeing": found.agreeing,
        "references": found.references,
        "best_inliers": found.best_inliers,
        "views": views,
    }


def _rounded(values: NDArray[np.float64]) -> list[object]:
    return list(np.round(values, 9).tolist())
