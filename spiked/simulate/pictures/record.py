"""Write what a simulated sensor sees of pictures as a recording, with the true path where poses are given."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import Image, Intrinsics, Sensor
from spiked.simulate.camera import LONG_STEP_PX
from spiked.simulate.exposure import Exposure
from spiked.simulate.motion import Recorded
from spiked.simulate.pictures.light import Framing, Node, Sites, Transfer, spans_between
from spiked.simulate.pictures.motion import Spacing, corners_moved, moved_nodes, shown
from spiked.simulate.pictures.reading import Pictures
from spiked.simulate.record import simulation_of, write_frames, write_picture, writing_into
from spiked.simulate.sensor import SpikeSensor
from spiked.simulate.spans import Span
from spiked.trajectory import Trajectory, tum_lines
from spiked.undistortion import Undistortion

GHOST_PX = 1.0
"""Motion between pictures above which interpolation shows both of them: an error of 0.9 % of white RMS, decision 14."""
_PAIRS = 64
"""Pairs of pictures whose motion is measured, evenly spread over time."""
_POSES = 16_384
"""Poses of the ground truth in memory at a time."""
_ROUNDING = 1e-3
"""Frames by which times of poses may be rounded: TUM files have nanoseconds."""
_DEPTH_RADII = 10.0
"""Length unit of views without depth, in radii of the path; it only sets the steps in which their poses are refined."""


class Interpolation(StrEnum):
    """How light between two pictures is made."""

    LINEAR = "linear"
    """Each pixel runs evenly from one picture to the next."""
    MOTION = "motion"
    """Each pixel moves along the optical flow from one picture to the next."""


@dataclass(frozen=True)
class PictureLight:
    """The light that pictures put on a sensor."""

    pictures: Pictures
    framing: Framing
    transfer: Transfer
    sites: Sites
    frame_rate_hz: float

    @property
    def frames(self) -> int:
        """Whole frames from the first picture to the last."""
        return int(self.times[-1] + 1e-6)

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """Of the pictures, in frames from the first one [n]."""
        return np.asarray((self.pictures.times_s - self.pictures.times_s[0]) * self.frame_rate_hz)

    def nodes(self, without: frozenset[int] = frozenset()) -> Iterator[Node]:
        """The pictures as light, but those whose numbers are in `without`. Raises RecordingError."""
        for number, (time, picture) in enumerate(zip(self.times, self.pictures.read(), strict=True)):
            if number not in without:
                light = self.sites.light(self.framing(self.transfer.linear(picture)))
                yield Node(float(time), np.asarray(light))

    def spacing(self, progress: Callable[[int], None] | None = None) -> Spacing:
        """How far consecutive pictures are apart; reads all of them. Raises RecordingError for one that is not usable.

        progress: called with the number of pictures read.
        """
        count = len(self.times)
        seconds = set(np.unique(np.linspace(1, count - 1, min(_PAIRS, count - 1)).round().astype(int)).tolist())
        moved, corners, before = [], 0, None
        for number, picture in enumerate(self.pictures.read()):
            if number in seconds or number + 1 in seconds:
                current = shown(self.sites.light(self.framing(self.transfer.linear(picture))))
                if number in seconds and before is not None:
                    lengths, found = corners_moved(before, current)
                    moved.append(lengths)
                    corners += found
                before = current
            if progress is not None:
                progress(number + 1)
        return Spacing.of(moved, corners, len(seconds))


@dataclass(frozen=True)
class PicturePath:
    """Known poses, in frames of a recording made of pictures."""

    motion: Recorded
    first: float
    last: float
    """Frames between which the path is known."""

    @classmethod
    def of(cls, path: Trajectory, light: PictureLight) -> "PicturePath":
        """path: camera to world, at times on the clock of the pictures. Raises ConfigurationError without overlap."""
        begin, end = light.pictures.times_s[[0, -1]]
        times = (path.times_s - begin) * light.frame_rate_hz
        if len(times) < 2 or times[-1] <= 0 or times[0] >= light.times[-1]:
            told = f"{path.times_s[0]:.3f} to {path.times_s[-1]:.3f} s" if len(times) else "none"
            raise ConfigurationError(
                f"poses ({told}) and pictures ({begin:.3f} to {end:.3f} s) are not of the same time: poses need the "
                "clock of the pictures"
            )
        return cls(Recorded(times, path.rotations, path.centres), max(float(times[0]), 0.0), float(times[-1]))

    def frames(self, count: int) -> NDArray[np.int64]:
        """Frames among the first `count` whose middle lies on the path [n]."""
        numbers = np.arange(count, dtype=np.int64)
        return numbers[self.covers(numbers.astype(np.float64) + 0.5)]

    def covers(self, times: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether moments in frames [n] lie on the path."""
        return (times >= self.first - _ROUNDING) & (times <= self.last + _ROUNDING)


@dataclass(frozen=True)
class PictureSimulation:
    """A recording to make of pictures."""

    light: PictureLight
    sensor: Sensor
    """With the optics of the recording, if they are known."""
    spikes: SpikeSensor
    frames: int
    """Length of the recording."""
    spacing: Spacing
    interpolation: Interpolation = Interpolation.LINEAR
    step_px: float = LONG_STEP_PX
    """Image motion between pictures made along the flow."""
    path: PicturePath | None = None
    views: int = 0
    """Pictures with poses to score against."""

    def __post_init__(self) -> None:
        if not 0 < self.frames <= self.light.frames:
            raise ConfigurationError(
                f"{self.frames} frames are asked for, and the pictures last for {self.light.frames} whole ones"
            )
        if self.views and self.path is None:
            raise ConfigurationError("views are pictures with poses: give --poses, too, or leave out --views")

    @cached_property
    def view_numbers(self) -> list[int]:
        """Numbers of the pictures that are views: evenly spread, within the path, no two of them neighbours."""
        if self.path is None or self.views == 0:
            return []
        times = self.light.times
        inside = np.flatnonzero(self.path.covers(times))
        inside = inside[(inside > 0) & (times[inside] < self.frames) & (inside < len(times) - 1)]
        if len(inside) == 0:
            return []
        chosen = np.linspace(0, len(inside) - 1, self.views + 2)[1:-1].round().astype(int)
        numbers = np.unique(inside[chosen]).tolist()
        return [number for number in numbers if number - 1 not in numbers or self.views == 1]

    @property
    def held_out(self) -> bool:
        """Whether views are left aside: the light between their neighbours must still be free of ghosts."""
        return bool(self.view_numbers) and 2 * self.spacing.p95_px <= GHOST_PX

    def spans(self) -> Iterator[Span]:
        """The light that the sensor is exposed to; views are left aside where `held_out`."""
        nodes = self.light.nodes(frozenset(self.view_numbers) if self.held_out else frozenset())
        if self.interpolation is Interpolation.MOTION:
            nodes = moved_nodes(nodes, self.step_px)
        return spans_between(nodes, self.light.sites)

    def described(self) -> dict[str, Any]:
        """What the sidecar says."""
        times, framing = self.light.pictures.times_s, self.light.framing
        rate = (len(times) - 1) / float(times[-1] - times[0])
        told: dict[str, Any] = {
            "count": len(times),
            "rate_hz": rate,
            "transfer": str(self.light.transfer),
            "size": list(framing.picture),
            "scaled": list(framing.scaled),
            "spacing": asdict(self.spacing),
            "interpolation": str(self.interpolation),
        }
        if self.interpolation is Interpolation.MOTION:
            told["step_px"] = self.step_px
        return simulation_of(self.spikes, self.light.sites.gain) | {"pictures": told}


def simulate_pictures(
    simulation: PictureSimulation,
    folder: Path | str,
    name: str,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Record into `folder`, which must be new or empty, and return the path of the recording.

    With a path the folder also holds groundtruth.tum, a pose for the middle of each frame that lies on it, and with
    views views.json and views/, as `spiked.simulate.record.simulate` writes them, but for the coverage. Memory does not
    grow with the number of pictures. Raises RecordingError and ConfigurationError.
    """
    folder, frames = Path(folder), simulation.frames
    data = folder / f"{name}.dat"
    with writing_into(folder, simulation.sensor):
        exposure = Exposure(simulation.spikes, simulation.spans())
        write_frames(data, simulation.sensor, exposure.next_frames, frames, simulation.described(), progress)
        if simulation.path is not None:
            with (folder / "groundtruth.tum").open("w", encoding="utf-8") as file:
                file.writelines(tum_lines(_truth(simulation.path, frames, simulation.sensor.frame_rate_hz)))
            _write_views(simulation, simulation.path, folder)
    return data


def _truth(path: PicturePath, count: int, rate_hz: float) -> Iterator[Trajectory]:
    known = path.frames(count)
    for begin in range(0, len(known), _POSES):
        middles = known[begin : begin + _POSES].astype(np.float64) + 0.5
        yield Trajectory(middles / rate_hz, *path.motion.poses(middles))


def _write_views(simulation: PictureSimulation, path: PicturePath, folder: Path) -> None:
    (folder / "views").mkdir()
    light, numbers = simulation.light, simulation.view_numbers
    straighten = _straightener(simulation.sensor.intrinsics, simulation.sensor)
    rotations, centres = path.motion.poses(light.times)
    entries: list[dict[str, Any]] = []
    for number, node in enumerate(light.nodes()) if numbers else ():
        if number not in numbers:
            continue
        file = f"views/{len(entries):02d}.png"
        write_picture(folder / file, straighten(node.light))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations[number], centres[number]
        entries.append(
            {
                "file": file,
                "on_trajectory": True,
                "held_out": simulation.held_out,
                "timestamp": node.frame / light.frame_rate_hz,
                "c2w": pose.tolist(),
            }
        )
    table = {
        "intensity": "spikes per frame = gain * value/255 + dark",
        "gain": light.sites.gain,
        "dark": simulation.spikes.noise.dark,
        "median_depth": _DEPTH_RADII * float(np.sqrt(np.var(centres, axis=0).sum())),
        "views": entries,
    }
    (folder / "views.json").write_text(json.dumps(table, indent=1), encoding="utf-8")


def _straightener(intrinsics: Intrinsics | None, sensor: Sensor) -> Callable[[Image], Image]:
    """Takes the distortion from a picture."""
    if intrinsics is None or intrinsics.distortion is None:
        return lambda image: image
    return Undistortion.of(intrinsics, sensor.width, sensor.height).straighten
