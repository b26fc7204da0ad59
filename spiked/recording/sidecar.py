"""The sidecar of a recording, `NAME.json` beside `NAME.dat`, and the `config.yaml` of SpikeCV's data sets."""

import operator
import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, StrictInt, ValidationError

from spiked.camera import Pinhole
from spiked.errors import ConfigurationError, RecordingError
from spiked.recording.geometry import Assumable
from spiked.sensor import BitOrder, Layout, Mosaic, Response, Sensor

RESERVED_BYTES = 256 << 10
"""Disk space reserved for the final sidecar: enough for some thousand gaps."""


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Gap(_Strict):
    """Frames of the capture that are missing from the file."""

    first: StrictInt = Field(ge=0)
    """Index in the capture, counted from the recording's first frame."""
    count: StrictInt = Field(gt=0)
    cause: str
    """Cause of the loss: device, usb, ring or disk."""


def lost_by_cause(gaps: Iterable[Gap]) -> dict[str, int]:
    """Lost frames by cause."""
    found: Counter[str] = Counter()
    for gap in gaps:
        found[gap.cause] += gap.count
    return dict(found)


class ClockPair(_Strict):
    """Host time at which a frame had arrived whole, Unix time in ns."""

    frame: StrictInt = Field(ge=0)
    unix_ns: StrictInt


class Sidecar(BaseModel):
    """Content of a sidecar. Unknown fields are kept by `read_sidecar` and written back."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    format: Layout
    width: StrictInt = Field(gt=0)
    height: StrictInt = Field(gt=0)
    frame_rate: StrictFloat = Field(gt=0)
    """Frames per second."""
    frames: StrictInt | None = Field(ge=0)
    """Whole frames in the file; null while the recording runs, and after a crash."""
    bit_order: BitOrder
    flipped: StrictBool
    """Rows are stored bottom-up."""
    cfa: Mosaic | None = None
    """Colour pattern of the upright image."""
    intrinsics: Pinhole | None = None
    response: Response = Field(
        Response.INTEGRATE_AND_FIRE, exclude_if=lambda value: value is Response.INTEGRATE_AND_FIRE
    )
    """How light becomes spikes."""
    pixel_centre: StrictFloat = Field(0.5, ge=0, le=0.5)
    """Coordinate of the first pixel's centre in the convention of the intrinsics."""
    note: str = ""
    first_frame: StrictInt = Field(default=0, ge=0)
    """Index in the capture of the file's first frame."""
    gaps: tuple[Gap, ...] = ()
    clock: tuple[ClockPair, ...] = ()
    calibration: str | None = None
    """Calibration file, relative to the sidecar."""
    device: dict[str, Any] | None = None
    """Properties that the camera reported."""
    profile: dict[str, Any] | None = None
    """The camera profile that the recording was made with."""
    assumed: tuple[Assumable, ...] = Field(default=(), exclude_if=operator.not_)
    """Fields above with a default that neither a user nor the camera stated."""

    @classmethod
    def of(cls, sensor: Sensor, frames: int | None, **more: Any) -> "Sidecar":
        """The sidecar of a recording of `sensor`; `more` are further fields."""
        return cls(
            format=sensor.layout,
            width=sensor.width,
            height=sensor.height,
            frame_rate=sensor.frame_rate_hz,
            frames=frames,
            bit_order=sensor.bit_order,
            flipped=sensor.flipped,
            cfa=sensor.mosaic,
            intrinsics=Pinhole.of(sensor.intrinsics),
            response=sensor.response,
            **more,
        )

    def sensor(self) -> Sensor:
        """The sensor it describes. Raises ConfigurationError for an invalid geometry."""
        k = self.intrinsics
        shift = 0.5 - self.pixel_centre
        return Sensor(
            self.width,
            self.height,
            self.frame_rate,
            self.format,
            self.bit_order,
            self.flipped,
            self.cfa,
            None if k is None else replace(k.intrinsics(), cx=k.cx + shift, cy=k.cy + shift),
            self.response,
        )


def sidecar_path(recording: Path) -> Path:
    """Path of a recording's sidecar."""
    return recording.with_suffix(".json")


def read_sidecar(path: Path) -> Sidecar:
    """Read and check a sidecar. Raises RecordingError with one line that names the field."""
    try:
        sidecar = Sidecar.model_validate_json(path.read_bytes())
        sidecar.sensor()
    except OSError as error:
        raise RecordingError(f"{path}: the sidecar cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise RecordingError(f"{path}: {_first_problem(error)}; correct the sidecar") from error
    except ConfigurationError as error:
        raise RecordingError(f"{path}: {error}; correct the sidecar") from error
    return sidecar


def recorded_calibration(recording: Path) -> Path | None:
    """The calibration file that a recording's sidecar names, if it is there; None without a sidecar.

    Raises RecordingError for a sidecar that cannot be read.
    """
    beside = sidecar_path(recording)
    named = read_sidecar(beside).calibration if beside.exists() else None
    path = None if named is None else beside.parent / named
    return path if path is not None and path.is_file() else None


def _first_problem(error: ValidationError) -> str:
    problem = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "missing":
        return f"field {field!r} is missing"
    if not field:
        return f"not a JSON object of a sidecar: {problem['msg']}"
    return f"field {field!r} is {problem['input']!r}: {problem['msg']}"


def write_sidecar(path: Path, sidecar: Sidecar) -> None:
    """Write a sidecar atomically: after a crash there is the old one or the new one. Raises OSError."""
    temporary = _temporary(path)
    content = sidecar.model_dump_json(indent=1).encode()
    # Write into the reserved space, if any: opening the file with "wb" would release it first.
    with temporary.open("r+b" if temporary.exists() else "wb") as file:
        file.write(content)
        file.truncate()
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def reserve_sidecar(path: Path) -> None:
    """Reserve the disk space of the next `write_sidecar`, so that it succeeds on a full disk. Raises OSError."""
    with _temporary(path).open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, RESERVED_BYTES)


def _temporary(path: Path) -> Path:
    return path.with_name(path.name + ".part")


class SpikeCvConfig(BaseModel):
    """`config.yaml` of a SpikeCV data set. It has sizes and labels, but no rate or orientation."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    spike_w: int = Field(gt=0)
    spike_h: int = Field(gt=0)
    is_labeled: bool = False
    labeled_data_type: tuple[float, ...] = ()
    """SpikeCV's ids: 0 none, 1 reconstruction, 2 flow, 3.1 and 3.2 depth, 4 detection, 5 tracking, 6 recognition."""


def find_spikecv_config(recording: Path) -> Path | None:
    """`config.yaml` in the recording's folder or, as in data sets with subfolders, in the one above."""
    folder = recording.absolute().parent
    for path in (folder / "config.yaml", folder.parent / "config.yaml"):
        if path.is_file():
            return path
    return None


def read_spikecv_config(path: Path) -> SpikeCvConfig | None:
    """Read a SpikeCV configuration; None if the file has neither size field and so is of another program."""
    try:
        content = yaml.safe_load(path.read_bytes())
        if not isinstance(content, dict) or not content.keys() & {"spike_w", "spike_h"}:
            return None
        return SpikeCvConfig.model_validate(content)
    except OSError as error:
        raise RecordingError(f"{path}: the configuration cannot be read: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise RecordingError(f"{path}: not YAML: {' '.join(str(error).split())}") from error
    except ValidationError as error:
        raise RecordingError(f"{path}: {_first_problem(error)}; correct it or state the geometry") from error
