"""Record short visits beside a path: what a camera sees that comes back to a known place, but not along the same way.

    .venv/bin/python evaluation/visits.py SCENE.ply PATH.tum OUT [--visits 60] [--frames 1000] [--seed 0]

Each visit begins at a random time of the path, beside it and turned away from it, and moves as the path does there,
with another tremor. OUT/visits.dat holds the visits one after the other, OUT/groundtruth.tum the poses.
"""

import argparse
from pathlib import Path

import numpy as np
from long_walk import smooth, tremor_like

from spiked.pose import exp_so3, log_so3
from spiked.recording import RecordingWriter
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.camera import DEFAULT_GAIN
from spiked.simulate.motion import Recorded
from spiked.simulate.splats import SplatScene
from spiked.trajectory import Trajectory

STEP_PX = 0.3
"""Image motion between exact pictures, as in `spiked simulate` of long paths."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("path", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--visits", type=int, default=60)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--beside-m", type=float, default=0.1, help="standard deviation along each axis")
    parser.add_argument("--turned-deg", type=float, default=4.0, help="standard deviation about each axis")
    parser.add_argument("--gain", type=float, help="spikes a frame of white; default: the scene's, or 0.35")
    parser.add_argument("--fov", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    sensor = Sensor(400, 250, 20_000.0, intrinsics=Intrinsics.from_fov(400, 250, given.fov))
    path = Trajectory.read_tum(given.path)
    calm, step = smooth(path), float(np.median(np.diff(path.times_s)))
    turns = log_so3(calm.rotations.swapaxes(1, 2) @ path.rotations)
    rng = np.random.default_rng(given.seed)
    shake = tremor_like(np.concatenate([path.centres - calm.centres, turns], 1), step, len(path), rng)
    rotations, centres = calm.rotations @ exp_so3(shake[:, 3:]), calm.centres + shake[:, :3]
    scene = Scene.read_ply(given.scene)
    splats, gain = SplatScene(scene, 2), given.gain or scene.white or DEFAULT_GAIN
    given.out.mkdir(parents=True)
    seen, moments = [], np.arange(given.frames)
    with RecordingWriter(given.out / "visits.dat", sensor) as out:
        for visit in range(given.visits):
            first = rng.uniform(0, path.times_s[-1] * sensor.frame_rate_hz - given.frames)
            moved = centres + given.beside_m * rng.standard_normal(3)
            turned = rotations @ exp_so3(np.radians(given.turned_deg) * rng.standard_normal(3))
            motion = Recorded(path.times_s * sensor.frame_rate_hz - first, turned, moved)
            camera = SimulatedCamera(sensor, given.seed + visit, motion, splats, gain=gain, step_px=STEP_PX, threads=2)
            out.append(camera.next_frames(given.frames))
            seen.append(camera.truth(moments))
    every = [np.concatenate(part) for part in zip(*seen, strict=True)]
    times = (np.arange(given.frames * given.visits) + 0.5) / sensor.frame_rate_hz
    Trajectory(times, *every).write_tum(given.out / "groundtruth.tum")


if __name__ == "__main__":
    main()
