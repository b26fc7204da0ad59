"""Write what a simulated camera sees as a recording with its truth: the folder that `evaluate` scores against."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, RecordingError
from spiked.pose import exp_so3
from spiked.recording import RecordingWriter
from spiked.scene import Scene
from spiked.sensor import BitOrder, Layout, Sensor
from spiked.simulate.camera import SimulatedCamera
from spiked.simulate.motion import Recorded
from spiked.simulate.sensor import SensorNoise
from spiked.simulate.splats import SplatScene
from spiked.trajectory import Trajectory

Array = NDArray[np.float64]

_CHUNK = 64


def camera_of_files(
    sensor: Sensor,
    ply: Path | str,
    tum: Path | str,
    *,
    seed: int = 0,
    noise: SensorNoise | None = None,
    gain: float = 0.35,
    threads: int = 1,
) -> SimulatedCamera:
    """A camera that looks at the Gaussians of a PLY along the path of a TUM file (camera-to-world, times in seconds).

    Between poses the path is even; before the first and after the last pose the camera stands still. Raises SceneError
    for files that cannot be read, and ConfigurationError for a path of fewer than two poses.
    """
    path = Trajectory.read_tum(tum)
    motion = Recorded(path.times_s * sensor.frame_rate_hz, path.rotations, path.centres)
    return SimulatedCamera(
        sensor, seed, motion, SplatScene(Scene.read_ply(ply), threads), noise, gain=gain, threads=threads
    )


def simulate(
    camera: SimulatedCamera,
    folder: Path | str,
    name: str,
    frames: int,
    *,
    views: int = 16,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Record `frames` frames into `folder`, with the truth, and return the path of the recording.

    The folder, which must be new or empty, then holds NAME.dat, its sidecar NAME.json, groundtruth.tum (a pose for the
    middle of each frame), and `views` held-out noise-free pictures in views/ with their poses in views.json; every
    other one lies beside the path, drawn by `seed`. `progress` is told the number of frames written. Raises
    RecordingError if the folder cannot be written or holds something, and ConfigurationError for a sensor whose frames
    are not compact and LSB first.
    """
    folder, sensor = Path(folder), camera.sensor
    if sensor.layout is not Layout.COMPACT or sensor.bit_order is not BitOrder.LSB:
        raise ConfigurationError(
            "simulated recordings are compact, LSB first; write one and convert it to another layout"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise RecordingError(f"{folder} is not empty; name a new folder for the simulated recording")
        data = folder / f"{name}.dat"
        described = replace(sensor, intrinsics=camera.intrinsics)
        simulation = {"seed": camera.spikes.seed, "gain": camera.gain, "noise": asdict(camera.spikes.noise)}
        with RecordingWriter(
            data, described, note="simulated; cfa is of the upright image", simulation=simulation
        ) as out:
            for begin in range(0, frames, _CHUNK):
                count = min(_CHUNK, frames - begin)
                out.append(camera.next_frames(count))
                if progress is not None:
                    progress(begin + count)
        rotations, centres = camera.truth(np.arange(frames))
        times = (np.arange(frames, dtype=np.float64) + 0.5) / sensor.frame_rate_hz
        Trajectory(times, rotations, centres).write_tum(folder / "groundtruth.tum")
        _write_views(camera, folder, rotations, centres, views=views, seed=seed)
    except OSError as error:
        raise RecordingError(f"cannot write the simulated recording in {folder}: {error.strerror}") from error
    return data


def _write_views(
    camera: SimulatedCamera, folder: Path, rotations: Array, centres: Array, *, views: int, seed: int
) -> None:
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x71E3]))
    (folder / "views").mkdir()
    chosen = np.linspace(0, len(centres) - 1, views + 2)[1:-1].round().astype(int)
    middle = len(centres) // 2
    median_depth = float(np.median(_finite(camera.depth(rotations[middle], centres[middle]))))
    entries = []
    for number, frame in enumerate(chosen):
        on_path = number % 2 == 0
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations[frame], centres[frame]
        if not on_path:
            pose[:3, 3] += 0.015 * median_depth * rng.standard_normal(3)
            pose[:3, :3] = pose[:3, :3] @ exp_so3(0.015 * rng.standard_normal(3))
        intensity = camera.view(pose[:3, :3], pose[:3, 3]) / camera.gain
        picture = np.round(np.clip(intensity, 0, 1) * 255).astype(np.uint8)
        file = f"views/{number:02d}.png"
        (folder / file).write_bytes(
            cv2.imencode(".png", picture[..., ::-1] if picture.ndim == 3 else picture)[1].tobytes()
        )
        entries.append(
            {
                "file": file,
                "on_trajectory": on_path,
                "timestamp": (int(frame) + 0.5) / camera.sensor.frame_rate_hz,
                "c2w": pose.tolist(),
                "coverage": _coverage(camera, pose, rotations[::64], centres[::64]),
            }
        )
    table = {
        "intensity": "spikes per frame = gain * value/255 + dark",
        "gain": camera.gain,
        "dark": camera.spikes.noise.dark,
        "median_depth": median_depth,
        "views": entries,
    }
    (folder / "views.json").write_text(json.dumps(table, indent=1), encoding="utf-8")


def _finite(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    return depth[np.isfinite(depth)]


def _coverage(camera: SimulatedCamera, pose: Array, rotations: Array, centres: Array) -> float:
    """The share of a view's points that lie within the picture of some pose of the path; occlusion is not looked at."""
    sensor, k = camera.sensor, camera.intrinsics
    depth = camera.depth(pose[:3, :3], pose[:3, 3])[::5, ::5].astype(np.float64)
    y, x = (np.mgrid[0 : sensor.height : 5, 0 : sensor.width : 5] + 0.5).reshape(2, *depth.shape)
    seen = np.isfinite(depth)
    rays = np.stack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones_like(x)], -1)[seen]
    points = pose[:3, 3] + (rays * depth[seen][:, None]) @ pose[:3, :3].T
    covered = np.zeros(len(points), bool)
    for rotation, centre in zip(rotations, centres, strict=True):
        local = (points - centre) @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = k.fx * local[:, 0] / local[:, 2] + k.cx, k.fy * local[:, 1] / local[:, 2] + k.cy
        covered |= (local[:, 2] > 0) & (u >= 0) & (u < sensor.width) & (v >= 0) & (v < sensor.height)
    return float(covered.mean()) if len(covered) else 0.0
