"""The scale of a reconstruction and which way is up in it: stored beside its versions, with their certainty."""

import shutil
import threading
from enum import StrEnum
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ValidationError

from spiked.errors import ConfigurationError, SceneError
from spiked.frame_of_reference import FrameOfReference, KnownScale
from spiked.pose import quaternion, rotation_of
from spiked.poses import PoseFile, Records
from spiked.whole_files import write_atomically
from spiked_service.base.errors import BusyError

SCALE = "scale.json"
"""Its file, in the folder of a reconstruction or of `spiked reconstruct`."""
METRIC = "metric"
"""Folder of `spiked scale` in that of `spiked reconstruct`: scene and path in metres."""
_WRITING = threading.Lock()


class ScaleSource(StrEnum):
    """What a scale rests on."""

    LENGTH = "length"
    """A known length."""
    TAG = "tag"
    """AprilTags of known size."""
    BOARD = "board"
    """A ChArUco board of known size."""
    BASELINE = "baseline"
    """Two cameras at a known distance."""


class SceneScale(BaseModel):
    """What is known of the unit and of the direction of up."""

    revision: int = 0
    """Counts the changes; 0: nothing is known."""
    metres_per_unit: float | None = None
    sigma: float | None = None
    """Relative standard deviation of the scale."""
    source: ScaleSource | None = None
    up: tuple[float, float, float] | None = None
    """Direction in the scene, of length 1."""
    version: int | None = None
    """Version of the scene that it was measured in."""
    since: int = 0
    """Versions up to this one are of an earlier run, whose unit of length is another one."""

    @property
    def frame(self) -> FrameOfReference | None:
        """The change to upright axes and metres; None while the scale is not known."""
        return None if self.metres_per_unit is None else FrameOfReference(self.metres_per_unit, self.up)

    @property
    def known(self) -> KnownScale:
        """What files in the scene's own unit and axes say."""
        return KnownScale("scene", self.metres_per_unit, self.sigma, self.up)

    def known_of(self, version: int) -> KnownScale:
        """The same for a version; nothing for one of an earlier run."""
        return self.known if version > self.since else KnownScale()

    def frame_of(self, version: int) -> FrameOfReference | None:
        """The same for a version; None for one of an earlier run."""
        return self.frame if version > self.since else None


def scale_headers(scale: KnownScale) -> dict[str, str]:
    """The headers that say what is known of the unit of an answer's lengths."""
    values = {"X-Metres-Per-Unit": scale.metres_per_unit, "X-Scale-Sigma": scale.scale_sigma}
    return {name: repr(value) for name, value in values.items() if value is not None}


def read_scale(folder: Path) -> SceneScale:
    """What is stored in a folder; revision 0 if nothing is. Raises SceneError for a damaged file."""
    try:
        return SceneScale.model_validate_json((folder / SCALE).read_bytes())
    except FileNotFoundError:
        return SceneScale()
    except (OSError, ValidationError) as error:
        raise SceneError(f"cannot read {folder / SCALE}: {error}; remove it and measure again") from error


def known_frame(folder: Path) -> FrameOfReference:
    """The change to metres that is stored in a folder. Raises ConfigurationError if none is, and SceneError."""
    frame = read_scale(folder).frame
    if frame is None:
        raise ConfigurationError(f"{folder} has no scale in metres; find it with `spiked scale {folder} --tag METRES`")
    return frame


def write_scale(folder: Path, scale: SceneScale, known: int | None = None) -> SceneScale:
    """Store a scale under the next revision; `known` is the one that it replaces, None: any. `since` stays.

    Raises BusyError if another one was stored meanwhile, SceneError, OSError.
    """
    with _WRITING:
        before = read_scale(folder)
        if known is not None and known != before.revision:
            raise BusyError(f"the scale is of revision {before.revision} now, not {known}: read it and change that one")
        stored = scale.model_copy(update={"revision": before.revision + 1, "since": before.since})
        write_atomically(folder / SCALE, stored.model_dump_json(indent=1).encode())
    return stored


def forget_scale(folder: Path, since: int) -> bool:
    """Forget scale and up, since versions after `since` have another unit. Return whether something was known.

    Raises OSError.
    """
    with _WRITING:
        try:
            before = read_scale(folder)
        except SceneError:
            before = SceneScale(metres_per_unit=1.0)  # damaged: it is replaced
        known = before.metres_per_unit is not None or before.up is not None
        if known or since:
            stored = SceneScale(revision=before.revision + 1, since=since)
            write_atomically(folder / SCALE, stored.model_dump_json(indent=1).encode())
    return known


def put_scale_back(folder: Path, before: SceneScale) -> None:
    """Undo `forget_scale`, since no version of another unit came. Raises SceneError, OSError."""
    with _WRITING:
        stored = before.model_copy(update={"revision": read_scale(folder).revision + 1})
        write_atomically(folder / SCALE, stored.model_dump_json(indent=1).encode())


def remove_scale(folder: Path) -> None:
    """Remove the scale of what is replaced in a folder of `spiked reconstruct`. Raises OSError."""
    (folder / SCALE).unlink(missing_ok=True)
    shutil.rmtree(folder / METRIC, ignore_errors=True)


class MetricPoses(PoseFile):
    """A pose file read in another frame of reference."""

    def __init__(self, path: Path, frame: FrameOfReference) -> None:
        """Raises SceneError."""
        super().__init__(path)
        self.frame = frame

    def records(self, rows: range) -> Records:
        """See `PoseFile.records`."""
        found = super().records(rows)
        found["position"] = self.frame.points(found["position"])
        found["quaternion_wxyz"] = quaternion(self.frame.rotation @ rotation_of(np.array(found["quaternion_wxyz"])))
        return found
