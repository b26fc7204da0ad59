"""Maps of the built-in room without a reconstruction, and visits to it, for tests of localisation."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spiked.pose import Array, exp_so3
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import Room, SimulatedCamera
from spiked.simulate.motion import hand_shake
from spiked.trajectory import Trajectory

OPTICS = Intrinsics.from_fov(240, 160, 60)
SENSOR = Sensor(240, 160, 20_000.0, intrinsics=OPTICS)
CAMERA = Camera(OPTICS, 240, 160)
GAIN = 0.35
UP = np.array([0.0, 0.0, 1.0])
TURNS_RAD = (0.0, 0.4, 0.8)
"""Where the camera of the map looks, from the room's own start."""
WAY_M = 0.3
"""How far it moves to the right in a radian."""


@dataclass(frozen=True)
class RoomMap:
    """A scene and the path through it."""

    scene: Scene
    path: Trajectory

    def write(self, folder: Path) -> Path:
        """Write what `spiked reconstruct` writes, and `localise` reads."""
        folder.mkdir()
        self.scene.write_ply(folder / "scene.ply", GAIN)
        self.path.write_tum(folder / "trajectory.tum")
        sensor = {"width": SENSOR.width, "height": SENSOR.height, "frame_rate_hz": SENSOR.frame_rate_hz}
        camera = {"sensor": sensor, "focal_px": [OPTICS.fx, OPTICS.fy]}
        (folder / "report.json").write_text(json.dumps({"outcome": "complete", **camera}))
        return folder


def room_map(seed: int, turns_rad: tuple[float, ...] = TURNS_RAD, camera: Camera = CAMERA) -> RoomMap:
    """The room of a seed as a splat for each pixel of some views, at its exact depth."""
    room, optics = Room(seed=seed), camera.intrinsics
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = optics.unproject(np.stack([x, y], -1).reshape(-1, 2))
    scene = Scene.empty(1)
    for turn in turns_rad:
        rotation, centre = _pose(room, turn)
        view = room.render(optics, camera.width, camera.height, rotation, centre)
        depth = view.depth.reshape(-1, 1)
        means = centre + (rays * depth) @ rotation.T
        count = len(means)
        scene = scene.join(
            Scene(
                means.astype(np.float32),
                np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
                np.log(np.repeat(0.45 * depth / optics.fx, 3, axis=1)).astype(np.float32),
                np.full(count, 4, np.float32),
                np.ascontiguousarray(GAIN * view.intensity.reshape(-1, 1), np.float32),
            )
        )
    poses = [_pose(room, turn) for turn in np.linspace(turns_rad[0], turns_rad[-1], 60)]
    times = (np.arange(len(poses)) + 0.5) / SENSOR.frame_rate_hz
    return RoomMap(scene, Trajectory(times, np.stack([r for r, _ in poses]), np.stack([c for _, c in poses])))


def twice(one: RoomMap) -> RoomMap:
    """The same place twice: the second time behind the first, turned by half a circle."""
    half, behind = exp_so3(np.pi * UP), np.array([0.0, -20.0, 0.0])
    scene, path = one.scene, one.path
    copied = scene.select(np.arange(len(scene)))
    copied.means = (scene.means @ half.T + behind).astype(np.float32)
    times = np.r_[path.times_s, path.times_s + 1]
    rotations = np.concatenate([path.rotations, half @ path.rotations])
    return RoomMap(
        scene.join(copied), Trajectory(times, rotations, np.r_[path.centres, path.centres @ half.T + behind])
    )


def visitor(seed: int, noise_seed: int = 5, gain: float = GAIN, flow_px: float = 0.05) -> SimulatedCamera:
    """A camera in the room of a seed, beside the path of its map."""
    room = Room(seed=seed)
    stage = room.stage(OPTICS, flow_px=flow_px)
    turn, beside = exp_so3(0.3 * UP), np.array([0.1, 0.05, 0.03])
    target = stage.centre + turn @ (stage.target - stage.centre)
    stage = replace(stage, centre=stage.centre + beside, target=target)
    return SimulatedCamera(SENSOR, noise_seed, hand_shake(stage, noise_seed), room, step_px=0.3, gain=gain)


def _pose(room: Room, turn: float) -> tuple[Array, Array]:
    stage = room.stage(OPTICS)
    return exp_so3(turn * UP) @ stage.rotation, stage.centre + np.array([WAY_M * turn, 0, 0])
