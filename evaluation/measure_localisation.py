"""Measure `spiked localise`: recall, errors and seconds on a known place, and false acceptances on foreign ones.

    .venv/bin/python evaluation/measure_localisation.py MAP REC.dat [--map-truth TUM] [--starts 200] [--frames 1000]
    .venv/bin/python evaluation/measure_localisation.py MAP [MAP ...] --foreign REC.dat [REC.dat ...]
    .venv/bin/python evaluation/measure_localisation.py MAP [MAP ...] --foreign-rooms 100

MAP is an output folder of `spiked reconstruct`. In the first form groundtruth.tum lies beside the recording, and
--map-truth is the ground truth of the recording that the map was made from, if it was another one. Position errors are
in percent of the RMS radius of the map's path:

* local: against the pose that the map gives to the truth. That is the map's own pose nearest to the true pose, moved by
  the way between the two in the truth. Errors of the map's path do not count.
* global: against the truth, moved by the similarity between the map's whole path and its truth. They do count.

With --foreign and --foreign-rooms, recordings are of other places: every acceptance is false. The rooms are built-in
rooms, each with textures of its own; their furniture stands alike in all. Every other one is seen from a random place,
the rest from where `spiked simulate` begins.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from spiked_service.results.map_folder import MapFolder

from spiked.errors import RecordingError
from spiked.evaluate import similarity_of_trajectories
from spiked.pose import exp_so3, log_so3
from spiked.recon.localisation.localiser import Localisation, Localiser
from spiked.recon.localisation.map_index import MapIndex
from spiked.recording import Recording, open_recording
from spiked.render import Camera
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import Room, SimulatedCamera, Stage
from spiked.simulate.motion import hand_shake
from spiked.trajectory import Trajectory

Array = NDArray[np.float64]

GOOD_PERCENT = 0.5
"""Largest position error of a recognised start."""
CHUNK_FRAMES = 250
"""Frames fed at a time."""
ROOM_M, MARGIN_M = np.array([6.0, 5.0, 2.8]), np.array([1.5, 1.2, 1.0])
"""Size of the built-in room, and distance of the camera from its walls."""


@dataclass(frozen=True)
class Outcome:
    """One recording searched in one map."""

    found: Localisation | None
    """None: too little texture or light."""
    wall_s: float
    cpu_s: float


def localise(index: MapIndex, sensor: Sensor, pieces: Iterator[tuple[int, NDArray[np.uint8]]]) -> Outcome:
    """Localise frames [n, frame_bytes] that come in pieces with the index of their first."""
    wall, cpu = time.perf_counter(), time.process_time()
    localiser = Localiser(index, sensor)
    for first, frames in pieces:
        localiser.feed(first, frames)
    try:
        found = localiser.finish()
    except RecordingError:
        found = None
    return Outcome(found, time.perf_counter() - wall, time.process_time() - cpu)


def pieces(recording: Recording, start: int, frames: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """The frames of a recording from `start` on."""
    for first in range(start, start + frames, CHUNK_FRAMES):
        yield first, recording.read(first, min(CHUNK_FRAMES, start + frames - first))


class Truth:
    """Where the camera of a recording was, in the frame of reference of a map."""

    def __init__(self, truth: Trajectory, map_truth: Trajectory, map_path: Trajectory, frame_rate_hz: float) -> None:
        self._truth = truth
        self._similarity = similarity_of_trajectories(truth=map_truth, estimate=map_path, frame_rate_hz=frame_rate_hz)
        rows = map_path.nearest(map_truth.times_s, 0.6 / frame_rate_hz)
        known = np.flatnonzero(rows >= 0)[::20]
        self._before = Trajectory(map_truth.times_s[known], map_truth.rotations[known], map_truth.centres[known])
        self._after = map_path.rotations[rows[known]], map_path.centres[rows[known]]
        spread = map_path.centres - map_path.centres.mean(0)
        self.radius = float(np.sqrt((spread**2).sum(1).mean()))

    def errors_percent(self, path: Trajectory) -> tuple[Array, Array]:
        """Local and global position errors [n] of poses."""
        rows = np.abs(self._truth.times_s[:, None] - path.times_s).argmin(0)
        rotations, centres = self._truth.rotations[rows], self._truth.centres[rows]
        whole = np.linalg.norm(path.centres - self._similarity.points(centres), axis=1)
        local = [
            np.linalg.norm(at - self._local(rotation, centre))
            for at, rotation, centre in zip(path.centres, rotations, centres, strict=True)
        ]
        return 100 * np.array(local) / self.radius, 100 * whole / self.radius

    def _local(self, rotation: Array, centre: Array) -> Array:
        """The map's pose nearest to a true pose, moved by the way between the two; half a metre counts as a radian."""
        way = np.linalg.norm(self._before.centres - centre, axis=1) / 0.5
        near = np.flatnonzero(way < way.min() + 0.3)
        turn = np.linalg.norm(log_so3(self._before.rotations[near].swapaxes(1, 2) @ rotation), axis=1)
        row = int(near[np.argmin(way[near] + turn)])
        moved = self._before.rotations[row].T @ (centre - self._before.centres[row])
        return np.asarray(self._after[1][row] + self._similarity.scale * self._after[0][row] @ moved)


def index_for(folder: MapFolder, intrinsics: Intrinsics | None, sensor: Sensor) -> MapIndex:
    return MapIndex(
        folder.scene, folder.trajectory, Camera(intrinsics or folder.intrinsics, sensor.width, sensor.height)
    )


def known_place(folder: MapFolder, recording: Recording, map_truth: Path | None, given: argparse.Namespace) -> None:
    """Print recall, errors and seconds of random starts."""
    sensor = recording.sensor
    begin = time.process_time()
    index = index_for(folder, sensor.intrinsics, sensor)
    print(f"index: {len(index)} reference views, {time.process_time() - begin:.1f} s of CPU")
    own = Trajectory.read_tum(recording.path.parent / "groundtruth.tum")
    other = own if map_truth is None else Trajectory.read_tum(map_truth)
    truth = Truth(own, other, folder.trajectory, sensor.frame_rate_hz)
    rng = np.random.default_rng(given.seed)
    if given.every:
        starts = np.arange(0, recording.frames - given.frames + 1, given.every)[: given.starts]
    else:
        starts = rng.integers(0, recording.frames - given.frames + 1, given.starts)
    local, whole, sigma, seconds, reasons, least = [], [], [], [], [], []
    for start in starts.tolist():
        outcome = localise(index, sensor, pieces(recording, start, given.frames))
        seconds.append((outcome.wall_s, outcome.cpu_s))
        if outcome.found is None or not outcome.found.recognised:
            reasons.append(f"frame {start}: {'no texture' if outcome.found is None else outcome.found.reason}")
            continue
        path = outcome.found.trajectory(sensor.frame_rate_hz)
        errors = truth.errors_percent(path)
        predicted = np.array([view.fit.sigma for view in outcome.found.views]) / truth.radius * 100
        sigma.append(np.sqrt(np.mean((errors[0] / predicted) ** 2)))
        least += [(view.fit.inliers, view.fit.share, view.correlation) for view in outcome.found.views]
        local.append(float(np.median(errors[0])))
        whole.append(float(np.median(errors[1])))
        if given.verbose or local[-1] > GOOD_PERCENT:
            print(f"frame {start}: local {local[-1]:.3f} % global {whole[-1]:.3f} % {outcome.found.reason}")
    print(*reasons, sep="\n")
    wall, cpu = np.array(seconds).T
    print(f"starts {len(starts)}, recognised {len(local)}")
    if not local:
        return
    for name, errors_ in (("local", np.array(local)), ("global", np.array(whole))):
        recall = (errors_ <= GOOD_PERCENT).sum() / len(starts)
        print(
            f"{name}: within {GOOD_PERCENT} % {recall:.1%}, median {np.median(errors_):.3f} %, "
            f"95 % {np.percentile(errors_, 95):.3f} %, worst {errors_.max():.3f} %"
        )
    inliers, share, likeness = np.array(least).min(0)
    print(f"lowest of {len(least)} views: {inliers:.0f} points, share {share:.2f}, correlation {likeness:.2f}")
    print(f"error over predicted deviation, RMS: {np.sqrt(np.mean(np.square(sigma))):.2f}")
    print(f"CPU s: median {np.median(cpu):.2f}, worst {cpu.max():.2f}; wall s: {np.median(wall):.2f}, {wall.max():.2f}")


@dataclass
class Foreign:
    """False acceptances, and how near others came."""

    pairs: int = 0
    accepted: int = 0
    inliers: int = 0
    """Most points that agreed with one pose in a pair."""

    def add(self, name: str, outcome: Outcome) -> None:
        """Count one pair."""
        self.pairs += 1
        if outcome.found is None:
            return
        self.inliers = max(self.inliers, outcome.found.best_inliers)
        if outcome.found.recognised:
            self.accepted += 1
            print(f"{name}: ACCEPTED, {outcome.found.reason}")

    def report(self) -> None:
        """Print the counts."""
        print(f"foreign pairs {self.pairs}, accepted {self.accepted}, most inliers {self.inliers}")


def foreign_recordings(maps: dict[str, MapFolder], files: list[Path], given: argparse.Namespace) -> None:
    """Search random starts of foreign recordings in every map."""
    count, rng = Foreign(), np.random.default_rng(given.seed)
    for name, folder in maps.items():
        for file in files:
            recording = open_recording(file)
            sensor = recording.sensor
            index = index_for(folder, sensor.intrinsics, sensor)
            frames = min(given.frames, recording.frames)
            for start in rng.integers(0, recording.frames - frames + 1, given.starts).tolist():
                outcome = localise(index, sensor, pieces(recording, start, frames))
                count.add(f"{file.name} at {start} in {name}", outcome)
    count.report()


def foreign_rooms(maps: dict[str, MapFolder], given: argparse.Namespace) -> None:
    """Search built-in rooms of random seeds, from random places, in every map."""
    count, rng = Foreign(), np.random.default_rng(given.seed)
    indices: dict[str, MapIndex] = {}
    for number in range(given.foreign_rooms):
        sensor, recorded = room_frames(1000 + given.seed * 1000 + number, given.frames, rng)
        for name, folder in maps.items():
            indices[name] = indices.get(name) or index_for(folder, sensor.intrinsics, sensor)
            outcome = localise(indices[name], sensor, iter([(0, recorded)]))
            count.add(f"room {number} in {name}", outcome)
    count.report()


def room_frames(seed: int, frames: int, rng: np.random.Generator) -> tuple[Sensor, NDArray[np.uint8]]:
    """Frames of a built-in room with the motion of a hand, from a random place if `seed` is even."""
    sensor = Sensor(400, 250, 20_000.0, intrinsics=Intrinsics.from_fov(400, 250, 60))
    assert sensor.intrinsics is not None
    centre = rng.uniform(MARGIN_M, ROOM_M - MARGIN_M)
    yaw, pitch = rng.uniform(0, 2 * np.pi), rng.uniform(-0.3, 0.1)
    ahead = exp_so3(np.array([0, 0, yaw])) @ np.array([np.cos(pitch), 0, np.sin(pitch)])
    stage = Stage(centre, centre + 2.5 * ahead, np.array([0.0, 0.0, 1.0]), sensor.intrinsics.fx, flow_px=0.03)
    room = Room(seed=seed)
    if seed % 2:
        stage = room.stage(sensor.intrinsics, flow_px=0.03)
    camera = SimulatedCamera(sensor, seed, hand_shake(stage, seed), room, step_px=1.0, threads=2)
    return sensor, camera.next_frames(frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", type=Path, nargs="+", metavar="MAP [REC]")
    parser.add_argument("--map-truth", type=Path)
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--every", type=int, help="starts so many frames apart instead of random ones")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--foreign", type=Path, nargs="+")
    parser.add_argument("--foreign-rooms", type=int)
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    if given.foreign is None and given.foreign_rooms is None:
        folder, file = given.places
        known_place(MapFolder.read(folder), open_recording(file), given.map_truth, given)
        return
    maps = {str(place): MapFolder.read(place) for place in given.places}
    if given.foreign is not None:
        foreign_recordings(maps, given.foreign, given)
    if given.foreign_rooms is not None:
        foreign_rooms(maps, given)


if __name__ == "__main__":
    main()
