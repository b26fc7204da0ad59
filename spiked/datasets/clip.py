"""What a data set holds: clips of spikes, scenes of pictures, and what is known of the truth of either."""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.calibration import Calibration
from spiked.errors import DatasetError
from spiked.recording import Sidecar, sidecar_path, whole_recording, write_sidecar
from spiked.recording.geometry import Assumable
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory

FEW_POINTS_DEPTH = 3.0
"""Median depth of a scene without known points, in radii of its path: it only sets the step of the pose refinement."""


@dataclass(frozen=True)
class TrueView:
    """A picture that was not made of the spikes, and the camera that took it."""

    file: Path
    time_s: float
    """Time since the clip's first frame."""
    pose: NDArray[np.float64]
    """Camera to world, OpenCV axes, float64 [4, 4]."""


@dataclass(frozen=True)
class Truth:
    """What the authors say of the path and of the scene."""

    path: Trajectory | None = None
    """Poses at some times since the clip's first frame."""
    views: tuple[TrueView, ...] = ()
    median_depth: float | None = None
    """Of the scene, in the unit of the path; None where no points are known."""

    def write(self, folder: Path) -> None:
        """Write groundtruth.tum and views.json as `spiked evaluate` reads them; pictures stay where they are.

        Nothing is written of what is not known. Raises OSError.
        """
        if self.path is None:
            return
        self.path.write_tum(folder / "groundtruth.tum")
        radius = float(np.sqrt(((self.path.centres - self.path.centres.mean(0)) ** 2).sum(1).mean()))
        depth = self.median_depth or FEW_POINTS_DEPTH * (radius or 1.0)
        views = [
            {"file": str(view.file.resolve()), "timestamp": view.time_s, "c2w": view.pose.tolist()}
            for view in self.views
        ]
        (folder / "views.json").write_text(json.dumps({"median_depth": depth, "views": views}, indent=1), "utf-8")


@dataclass(frozen=True)
class Clip:
    """A run of frames without a gap: one recording."""

    name: str
    """Unique in the data set; parts are separated by slashes."""
    files: tuple[Path, ...]
    """Files that the frames come from, in the order of time."""
    sensor: Sensor
    frames: int
    blocks: Callable[[], Iterator[NDArray[np.uint8]]]
    """Compact frames in stored row order, uint8 [n, frame_bytes], LSB first, from the beginning."""
    is_recording: bool = False
    """The only file is a recording as it is, and is not copied."""
    assumed: tuple[Assumable, ...] = ()
    """Properties of the sensor that nobody stated."""
    notes: tuple[str, ...] = ()
    """Sentences for the user."""
    truth: Truth = field(default_factory=Truth)
    dead: NDArray[np.bool_] | None = None
    """Pixels to leave out, of the upright image, bool [height, width]."""
    described_by: tuple[Path, ...] = ()
    """Files with poses and masks."""

    def write(self, folder: Path, dataset: str) -> Path:
        """Make the recording in a new folder, with sidecar and truth, and return the path of its `.dat`.

        A file that is a recording as it is becomes a symbolic link. Raises OSError, DatasetError and RecordingError.
        """
        folder.mkdir(parents=True)
        path = folder / f"{self.name.rsplit('/', 1)[-1]}.dat"
        more: dict[str, Any] = {"note": f"{dataset}: {self.name}"}
        if self.assumed:
            more["assumed"] = self.assumed
        if self.dead is not None and self.dead.any():
            flat = np.ones(self.dead.shape, np.float32)
            Calibration(flat, np.zeros_like(flat), self.dead).write(folder / "calibration.npz")
            more["calibration"] = "calibration.npz"
        if self.is_recording:
            path.symlink_to(self.files[0].resolve())
            write_sidecar(sidecar_path(path), Sidecar.of(self.sensor, self.frames, **more))
        else:
            self._copy(path, more)
        self.truth.write(folder)
        return path

    def _copy(self, path: Path, more: dict[str, Any]) -> None:
        with whole_recording(path, self.sensor.compact(), **more) as writer:
            for block in self.blocks():
                writer.append(block)
            count = writer.frames
        if count != self.frames:
            raise DatasetError(f"{self.name}: {count} frames could be read and {self.frames} were expected")


@dataclass(frozen=True)
class PictureScene:
    """Pictures of a place with the cameras that took them; spikes are made of them by the simulator."""

    name: str
    """Unique in the data set; parts are separated by slashes."""
    pictures: tuple[Path, ...]
    """In the order of the path: that of their names, in which numbers count as numbers."""
    rotations: NDArray[np.float64]
    """Camera to world, OpenCV axes, float64 [n, 3, 3]."""
    centres: NDArray[np.float64]
    """float64 [n, 3], in the unit of the data set."""
    intrinsics: Intrinsics
    width: int
    height: int
    median_depth: float | None = None
    """Of the points that the cameras see; None where none are known."""
    times_s: NDArray[np.float64] | None = None
    """Times of the pictures, float64 [n], where the data set has them."""
    described_by: tuple[Path, ...] = ()
    """Files with cameras and poses."""

    def trajectory(self, picture_rate_hz: float) -> Trajectory:
        """The path at the times of the data set; where it has none the pictures are evenly spaced in time."""
        times = np.arange(len(self.pictures)) / picture_rate_hz if self.times_s is None else self.times_s
        return Trajectory(np.asarray(times, np.float64), self.rotations, self.centres)


Item = Clip | PictureScene
"""What a data set holds."""


@dataclass(frozen=True)
class Dataset:
    """A folder of a data set, opened."""

    kind: str
    folder: Path
    items: tuple[Item, ...]

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that were or will be read, sorted, each once: those of the checksums."""
        found: set[Path] = set()
        for item in self.items:
            found.update(item.described_by)
            if isinstance(item, PictureScene):
                found.update(item.pictures)
            else:
                found.update(item.files)
                found.update(view.file for view in item.truth.views)
        return tuple(sorted(found))

    def of(self, items: Iterable[Item]) -> "Dataset":
        """The same folder with these of its items only."""
        return replace(self, items=tuple(items))
