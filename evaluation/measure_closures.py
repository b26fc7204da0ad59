"""What closed loops gain, and whether a place is ever taken for another.

    .venv/bin/python evaluation/measure_closures.py WALK [--foreign-rooms 200] [--twin SCENE.ply]

WALK is the output of `spiked simulate` of a path that returns. It is tracked twice, with loops and without. The error
at the return is that of the way between two true poses that see the same place more than half of the path apart, in
percent of the RMS radius of the path, after both paths have the same scale. A closure is false if the axes of its two
views are more than 45 degrees apart in truth, or their places more than twice the radius of the path.

--foreign-rooms searches views of built-in rooms, each with textures of its own, among the places of the walk, as those
of a lost camera are. --twin turns twice about the middle of a scene of which one half was replaced by the other, turned
by 180 degrees: what is seen in opposite directions is the same to the last splat.
"""

import argparse
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from measure_localisation import room_frames
from numpy.typing import NDArray

from spiked.evaluate import score_trajectory, similarity_of_trajectories
from spiked.recon import Options, Reconstructor
from spiked.recon.frontend.windowing import Windows
from spiked.recon.odometry import keyframe_adjuster
from spiked.recon.odometry.loop_closure import LoopSearch
from spiked.recon.odometry.odometry import Odometry
from spiked.recon.odometry.second_map import Meeting
from spiked.recon.odometry.sparse_map import TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.recording import open_recording
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.camera import DEFAULT_GAIN
from spiked.simulate.motion import Recorded
from spiked.simulate.splats import SplatScene
from spiked.trajectory import Trajectory

Array = NDArray[np.float64]

FEED_FRAMES = 64
TWIN_FRAMES, TWIN_RADIUS_M = 60_000, 0.5
"""Two turns."""
FALSE_TURN = np.cos(np.radians(45))
FALSE_WAY = 2.0
"""Of the radius of the path."""
SAME_TURN, SAME_WAY = np.cos(np.radians(8)), 0.1
"""Poses that see the same place."""


def tracked(sensor: Sensor, frames: int, block: "Blocks") -> Reconstructor:
    """All frames tracked to the end."""
    made = Reconstructor(sensor, Options(steps=0))
    for first in range(0, frames, FEED_FRAMES):
        made.feed(first, block(first, min(FEED_FRAMES, frames - first)))
    made.odometry.end()
    return made


class Blocks:
    """Frames of a recording or of a simulated camera, in order."""

    def __init__(self, source: object) -> None:
        self._source = source

    def __call__(self, first: int, count: int) -> NDArray[np.uint8]:
        if isinstance(self._source, SimulatedCamera):
            return self._source.next_frames(count)
        return np.array(self._source.read(first, count))  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Truth:
    """True poses and the radius of the path."""

    path: Trajectory

    @property
    def radius(self) -> float:
        """RMS distance from the middle."""
        return float(np.sqrt(((self.path.centres - self.path.centres.mean(0)) ** 2).sum(1).mean()))

    def false(self, closures: list[tuple[float, float]]) -> int:
        """Closures between two places."""
        rows = np.array(closures).astype(int).clip(0, len(self.path) - 1).reshape(-1, 2)
        axes, centres = self.path.rotations[rows][..., 2], self.path.centres[rows]
        way = np.linalg.norm(centres[:, 0] - centres[:, 1], axis=1) / self.radius
        turn = (axes[:, 0] * axes[:, 1]).sum(1)
        if len(rows):
            print(f"closures: {way.max():.2f} radii and {np.degrees(np.arccos(turn.min())):.0f} degrees apart at most")
        return int(((way > FALSE_WAY) | (turn < FALSE_TURN)).sum())

    def return_percent(self, estimate: Trajectory, rate_hz: float) -> float:
        """Median error of the way between poses of the return and of the first time there."""
        scale = similarity_of_trajectories(truth=self.path, estimate=estimate, frame_rate_hz=rate_hz).scale
        rows = np.arange(0, len(self.path), 500)
        near = estimate.nearest(self.path.times_s[rows], 0.6 / rate_hz)
        rows, near = rows[near >= 0], near[near >= 0]
        errors = []
        for k, (row, own) in enumerate(zip(rows, near, strict=True)):
            early = np.flatnonzero(rows[:k] < row - len(self.path) / 2)
            way = np.linalg.norm(self.path.centres[rows[early]] - self.path.centres[row], axis=1)
            turn = self.path.rotations[rows[early]][:, :, 2] @ self.path.rotations[row][:, 2]
            early = early[(way < SAME_WAY * self.radius) & (turn > SAME_TURN)]
            if not len(early):
                continue
            first = early[0]
            true = self.path.rotations[rows[first]].T @ (self.path.centres[row] - self.path.centres[rows[first]])
            found = estimate.rotations[near[first]].T @ (estimate.centres[own] - estimate.centres[near[first]])
            errors.append(np.linalg.norm(true - found / scale))
        return 100 * float(np.median(errors)) / self.radius


def walk(folder: Path) -> Odometry:
    """Print what loops gain; returns the odometry with loops."""
    recording = open_recording(next(folder.glob("*.dat")))
    truth, rate = Truth(Trajectory.read_tum(folder / "groundtruth.tum")), recording.sensor.frame_rate_hz
    results = {}
    for loops in (True, False):
        begun = time.process_time()
        unsearched = patch.object(LoopSearch, "search", lambda self, view: [])
        unclosed = patch.object(keyframe_adjuster, "find_closures", lambda *of: [])
        with nullcontext() if loops else unsearched, nullcontext() if loops else unclosed:
            made = tracked(recording.sensor, recording.frames, Blocks(recording))
        path = made.trajectory()
        errors = score_trajectory(truth=truth.path, estimate=path, frame_rate_hz=rate).errors
        assert errors is not None
        back, cpu = truth.return_percent(path, rate), time.process_time() - begun
        closures = made.odometry.closures
        print(
            f"loops {loops}: {len(closures)} closures, {truth.false(closures)} of them false; ATE "
            f"{errors.ate_percent:.2f} %, error at the return {back:.2f} %; {cpu:.0f} CPU s",
            flush=True,
        )
        results[loops] = made.odometry
    return results[True]


def foreign(odometry: Odometry, rooms: int) -> None:
    """Print how many views of other rooms are recognised."""
    pictures = odometry.keyframe_images
    loops = LoopSearch.of(odometry.map, pictures)
    rng, accepted, most = np.random.default_rng(0), 0, 0
    made = Reconstructor(Sensor(400, 250, 20_000.0, intrinsics=odometry.intrinsics))
    for number in range(rooms):
        sensor, frames = room_frames(5000 + number, 64, rng)
        windows = Windows(sensor, 64)
        view = [*windows.feed(0, frames), *windows.flush()][0]
        picture = made.picture(view)
        lost = TrackedView(len(odometry.views), 0.0, 64, np.zeros(0, int), np.zeros((0, 2)), 0.0, State.LOST)
        odometry.views.append(lost)
        found = Meeting(odometry.map, loops, pictures).search(lost, picture)
        odometry.views.pop()
        odometry.map._travelled_px.clear()
        accepted += found is not None
        if found is not None:
            most = max(most, len(found.ids))
            print(f"room {number}: taken for the place at frame {found.earlier.time:.0f}, {len(found.ids)} points")
    print(f"foreign rooms {rooms} among {len(loops.index.places)} places: {accepted} accepted", flush=True)


def twin(path: Path) -> None:
    """Print the closures in a scene that looks alike in opposite directions."""
    scene = Scene.read_ply(path)
    middle = np.array([3.0, -3.4, 1.45])
    half = scene.select(scene.means[:, 0] > middle[0])
    w, x, y, z = half.quats.T
    turned = replace(
        half,
        means=np.ascontiguousarray((half.means - middle) * [-1, -1, 1] + middle, np.float32),
        quats=np.ascontiguousarray(np.stack([-z, -y, x, w], 1), np.float32),  # half a turn about z, then as before
    )
    sensor = Sensor(400, 250, 20_000.0, intrinsics=Intrinsics.from_fov(400, 250, 60))
    frames = np.arange(0, TWIN_FRAMES + 1, 40, dtype=float)
    angle = 4 * np.pi * frames / TWIN_FRAMES
    ahead = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], 1)
    down = np.broadcast_to([0.0, 0.0, -1.0], ahead.shape)
    rotations = np.stack([np.cross(down, ahead), down, ahead], 2)
    motion = Recorded(frames, rotations, middle + TWIN_RADIUS_M * ahead)
    splats, gain = SplatScene(half.join(turned), 2), scene.white or DEFAULT_GAIN
    camera = SimulatedCamera(sensor, 0, motion, splats, gain=gain, step_px=0.3, threads=2)
    made = tracked(sensor, TWIN_FRAMES, Blocks(camera))
    poses = camera.truth(np.arange(TWIN_FRAMES))
    truth = Truth(Trajectory((np.arange(TWIN_FRAMES) + 0.5) / sensor.frame_rate_hz, *poses))
    path_ = made.trajectory()
    score = score_trajectory(truth=truth.path, estimate=path_, frame_rate_hz=sensor.frame_rate_hz)
    closures = made.odometry.closures
    print(
        f"twin: {len(closures)} closures, {truth.false(closures)} of them false; coverage {score.coverage:.3f}, "
        f"ATE {score.errors.ate_percent if score.errors else np.nan:.2f} %, {made.odometry.reason}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walk", type=Path)
    parser.add_argument("--foreign-rooms", type=int, default=0)
    parser.add_argument("--twin", type=Path)
    given = parser.parse_args()
    if given.twin:
        twin(given.twin)
    odometry = walk(given.walk)
    if given.foreign_rooms:
        foreign(odometry, given.foreign_rooms)


if __name__ == "__main__":
    main()
