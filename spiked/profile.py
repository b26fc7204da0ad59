"""Camera profiles: one JSON file a camera, with all that its stream does not say."""

import hashlib
import os
import secrets
from pathlib import Path
from typing import Literal, TypeVar
from urllib.parse import quote

from pydantic import ConfigDict, Field, ValidationError

from spiked.camera import CameraOptions, LocalPath, Pinhole, Side
from spiked.errors import ProfileError
from spiked.sensor import Sensor

__all__ = ["CameraProfile", "find_profile", "profile_path"]

SHARED_SERIALS = frozenset({"000000000001"})
"""Serial numbers that many cameras have: the one that FTDI's bridges leave the factory with."""
LONGEST_NAME = 200
"""Characters of a file name before `.json`, of the 255 that file systems allow."""
_OPTICS = {"fov", "intrinsics"}

_Options = TypeVar("_Options", bound=CameraOptions)


class CameraProfile(CameraOptions):
    """What is known of one camera; null or left out: not known. Its fields are the options of the same names."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True, strict=True
    )

    model: str = Field(default="", max_length=200)
    """Name of the product."""
    serial: str | None = Field(default=None, max_length=200)
    """Serial number of the camera that the profile is of; null: of any."""
    width: Side | None = None
    """Pixels in a row."""
    height: Side | None = None
    """Rows."""
    intrinsics: Pinhole | None = None
    """Pinhole model in pixels, instead of a field of view; the first pixel's centre is (0.5, 0.5)."""
    calibration: LocalPath | None = None
    """File of gains, dark rates and dead pixels, relative to the profile."""
    session: Literal["auto", "request", "stream"] | None = None
    """How the bridge of a USB camera is made to send."""
    note: str = Field(default="", max_length=20_000)

    @classmethod
    def read(cls, path: Path) -> "CameraProfile":
        """Read and check a profile. Raises ProfileError with one line that names the field."""
        try:
            return cls.model_validate_json(path.read_bytes())
        except OSError as error:
            raise ProfileError(f"{path}: the camera profile cannot be read: {error.strerror or error}") from error
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            where = ".".join(str(part) for part in problem["loc"])
            what = f"field {where!r}: " if where else ""
            message = problem["msg"].removeprefix("Value error, ")
            raise ProfileError(f"{path}: {what}{message}; correct the camera profile") from error

    def write(self, path: Path) -> None:
        """Write atomically: after a crash there is the old profile or the new one. Raises ProfileError."""
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
        try:
            try:
                with temporary.open("wb") as file:
                    file.write(self.model_dump_json(indent=1, exclude_defaults=True).encode() + b"\n")
                    file.flush()
                    os.fsync(file.fileno())
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)
        except OSError as error:
            raise ProfileError(f"{path}: the camera profile cannot be written: {error.strerror}") from error

    def check(self, sensor: Sensor) -> None:
        """Raises ProfileError if it is of a camera of another size."""
        size = (self.width or sensor.width, self.height or sensor.height)
        if size != (sensor.width, sensor.height):
            raise ProfileError(
                f"the camera profile is of {size[0]}x{size[1]} pixels and the camera of "
                f"{sensor.width}x{sensor.height}: use the profile of this camera, or correct its width and height"
            )

    def completed(self, options: _Options, *, size: bool = True) -> _Options:
        """The options, with what they do not state as here; a stated optics excludes the other kind of it.

        `size`: width and height, too, where nothing else says them.
        """
        stated = options.model_fields_set
        names = CameraOptions.model_fields.keys() | {"session"} | ({"width", "height"} if size else set())
        names &= type(options).model_fields.keys()
        if stated & _OPTICS:
            names -= _OPTICS
        known = {name: getattr(self, name) for name in names - stated}
        return options.model_copy(update={name: value for name, value in known.items() if value is not None})


def profile_path(folder: Path, device: str, serial: str | None) -> Path:
    """File of a camera's profile: of its serial number if that is its own, else of the device's address."""
    name = quote(serial if serial is not None and serial not in SHARED_SERIALS else device, safe="")
    if len(name) > LONGEST_NAME:
        name = f"{name[:LONGEST_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return folder / f"{name}.json"


def find_profile(folder: Path, device: str, serial: str | None) -> Path | None:
    """The profile in the folder that is named after the camera's serial number or the device's address, if any."""
    for path in (profile_path(folder, device, serial), profile_path(folder, device, None)):
        if path.exists():
            return path
    return None
