"""Write what a simulated camera sees as a recording with its truth: the folder that `evaluate` scores against."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, RecordingError
from spiked.pose import exp_so3
from spiked.recording import RecordingWriter
from spiked.scene import Scene
from spiked.sensor import BitOrder, Layout, Sensor
from spiked.simulate.camera import DEFAULT_GAIN, SimulatedCamera
from spiked.simulate.motion import Recorded
from spiked.simulate.sensor import Lighting, SensorNoise, SpikeSensor
from spiked.simulate.splats import SplatScene
from spiked.trajectory import Trajectory, tum_lines

Array = NDArray[np.float64]

_CHUNK = 64
"""Frames written at a time."""
_POSES = 16_384
"""Poses of the ground truth in memory at a time."""

_COVERAGE_STRIDE = 64
"""Frames between the poses that the coverage of a view is computed from."""

_PAIRS = 100_000
"""Points times poses that are projected at a time."""

_BESIDE = 0.015
"""Standard deviation of a view beside the path, along and about each axis: radians, and shares of the median depth."""

_SEEN_SHARE, _DRAWS = 0.999, 32
"""Coverage from which a drawn view beside the path is taken, and the draws of which else the best is: what no frame
saw cannot be reconstructed, and would score the scene's corners instead of the reconstruction."""


def camera_of_files(
    sensor: Sensor,
    ply: Path | str,
    tum: Path | str,
    *,
    seed: int = 0,
    noise: SensorNoise | None = None,
    lighting: Lighting | None = None,
    gain: float | None = None,
    step_px: float | None = None,
    threads: int = 1,
) -> SimulatedCamera:
    """A camera that looks at the Gaussians of a PLY along the path of a TUM file (camera-to-world, times in seconds).

    gain: spikes a frame of white. If None, it is what the PLY says of its white, so that the camera sees the scene's
    own radiance, or 0.35 if the PLY does not say it.
    step_px: see `SimulatedCamera`.
    Between poses the path is even; before the first and after the last pose the camera stands still. Raises SceneError
    for files that cannot be read, and ConfigurationError for a path of fewer than two poses.
    """
    path = Trajectory.read_tum(tum)
    motion = Recorded(path.times_s * sensor.frame_rate_hz, path.rotations, path.centres)
    scene = Scene.read_ply(ply)
    if gain is None:
        gain = scene.white or DEFAULT_GAIN
    splats = SplatScene(scene, threads)
    return SimulatedCamera(
        sensor, seed, motion, splats, noise, gain=gain, lighting=lighting, step_px=step_px, threads=threads
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
    middle of each frame), and `views` held-out noise-free pictures in views/ with their poses in views.json, evenly
    spread over time; every other one lies beside the path, drawn by `seed` so that frames saw 0.999 of its points
    (`coverage`, without occlusion) if that can be had. These pictures have no distortion; of a lens with distortion,
    views_lens/ has pictures of the same poses as the lens shows them. If the camera interpolates between exact
    pictures, `simulation.interpolation` of the sidecar is the error of that, measured as in `InterpolationError`.
    Memory does not grow with `frames`. `progress` is called with the number of frames written. Raises RecordingError
    if the folder cannot be written or holds something, and ConfigurationError for a sensor whose frames are not compact
    and LSB first.
    """
    folder, sensor = Path(folder), camera.sensor
    with writing_into(folder, sensor):
        data = folder / f"{name}.dat"
        simulation = simulation_of(camera.spikes, camera.gain)
        error = camera.interpolation_error(frames)
        if error is not None:
            simulation["interpolation"] = asdict(error)
        write_frames(
            data, replace(sensor, intrinsics=camera.intrinsics), camera.next_frames, frames, simulation, progress
        )
        with (folder / "groundtruth.tum").open("w", encoding="utf-8") as file:
            file.writelines(tum_lines(_truth(camera, frames)))
        _write_views(camera, folder, frames, views=views, seed=seed)
    return data


@contextmanager
def writing_into(folder: Path, sensor: Sensor) -> Iterator[None]:
    """Make a folder for a simulated recording, which must be new or empty, and is empty again after an error.

    Raises RecordingError if it cannot be written, then and later, and ConfigurationError for a sensor whose frames are
    not compact and LSB first.
    """
    if sensor.layout is not Layout.COMPACT or sensor.bit_order is not BitOrder.LSB:
        raise ConfigurationError(
            "simulated recordings are compact, LSB first; write one and convert it to another layout"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_empty(folder)
        with _emptied_after_an_error(folder):
            yield
    except OSError as error:
        raise RecordingError(f"cannot write the simulated recording in {folder}: {error.strerror}") from error


@contextmanager
def _emptied_after_an_error(folder: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        for made in folder.iterdir():
            shutil.rmtree(made) if made.is_dir() else made.unlink()
        raise


def check_empty(folder: Path) -> None:
    """Raises RecordingError for a folder that holds something."""
    if folder.is_dir() and any(folder.iterdir()):
        raise RecordingError(f"{folder} is not empty; name a new folder for the simulated recording")


def write_frames(
    data: Path,
    sensor: Sensor,
    next_frames: Callable[[int], NDArray[np.uint8]],
    frames: int,
    simulation: dict[str, Any],
    progress: Callable[[int], None] | None,
) -> None:
    """Write a recording with its sidecar, within `writing_into`.

    `next_frames` gives as many frames as it is asked for [n, frame_bytes].
    """
    note = "simulated; cfa is of the upright image"
    with RecordingWriter(data, sensor, note=note, simulation=simulation) as out:
        for begin in range(0, frames, _CHUNK):
            count = min(_CHUNK, frames - begin)
            out.append(next_frames(count))
            if progress is not None:
                progress(begin + count)


def write_picture(file: Path, intensity: NDArray[np.float32]) -> None:
    """Write a noise-free picture [H, W] or [H, W, 3], linear from 0 to 1, as a PNG of 8 bits."""
    picture = np.round(np.clip(intensity, 0, 1) * 255).astype(np.uint8)
    file.write_bytes(cv2.imencode(".png", picture[..., ::-1] if picture.ndim == 3 else picture)[1].tobytes())


def simulation_of(spikes: SpikeSensor, gain: float) -> dict[str, Any]:
    """What a sidecar says of the simulated sensor."""
    told = {"seed": spikes.seed, "gain": gain, "noise": asdict(spikes.noise)}
    return told if spikes.lighting == Lighting() else told | {"lighting": asdict(spikes.lighting)}


def _truth(camera: SimulatedCamera, frames: int) -> Iterator[Trajectory]:
    for begin in range(0, frames, _POSES):
        numbers = np.arange(begin, min(begin + _POSES, frames))
        times = (numbers.astype(np.float64) + 0.5) / camera.sensor.frame_rate_hz
        yield Trajectory(times, *camera.truth(numbers))


def _write_views(camera: SimulatedCamera, folder: Path, frames: int, *, views: int, seed: int) -> None:
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x71E3]))
    (folder / "views").mkdir()
    chosen = np.linspace(0, frames - 1, views + 2)[1:-1].round().astype(int)
    rotations, centres = camera.truth(chosen)
    path = camera.truth(np.arange(0, frames, _COVERAGE_STRIDE))
    middle_rotations, middle_centres = camera.truth([frames // 2])
    median_depth = float(np.median(_finite(camera.depth(middle_rotations[0], middle_centres[0], undistorted=True))))
    through_lens = camera.intrinsics.distortion is not None
    if through_lens:
        (folder / "views_lens").mkdir()
    entries = []
    for number, frame in enumerate(chosen):
        on_path = number % 2 == 0
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations[number], centres[number]
        nearest = int(frame) // _COVERAGE_STRIDE
        covered = _coverage(camera, pose, path, nearest)
        if not on_path:
            pose, covered = _beside(camera, pose, path, nearest, median_depth, rng)
        files = {"file": f"views/{number:02d}.png"}
        _write_view(camera, pose, folder / files["file"], undistorted=True)
        if through_lens:
            files["lens_file"] = f"views_lens/{number:02d}.png"
            _write_view(camera, pose, folder / files["lens_file"], undistorted=False)
        entries.append(
            {
                **files,
                "on_trajectory": on_path,
                "timestamp": (int(frame) + 0.5) / camera.sensor.frame_rate_hz,
                "c2w": pose.tolist(),
                "coverage": covered,
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


def _beside(
    camera: SimulatedCamera,
    pose: Array,
    path: tuple[Array, Array],
    nearest: int,
    median_depth: float,
    rng: np.random.Generator,
) -> tuple[Array, float]:
    """A random pose beside one of the path, and its coverage."""
    best, most = pose, -1.0
    for _ in range(_DRAWS):
        drawn = pose.copy()
        drawn[:3, 3] += _BESIDE * median_depth * rng.standard_normal(3)
        drawn[:3, :3] = pose[:3, :3] @ exp_so3(_BESIDE * rng.standard_normal(3))
        covered = _coverage(camera, drawn, path, nearest)
        if covered > most:
            best, most = drawn, covered
        if covered >= _SEEN_SHARE:
            break
    return best, most


def _write_view(camera: SimulatedCamera, pose: Array, path: Path, *, undistorted: bool) -> None:
    write_picture(path, camera.view(pose[:3, :3], pose[:3, 3], undistorted) / camera.gain)


def _finite(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    return depth[np.isfinite(depth)]


def _coverage(camera: SimulatedCamera, pose: Array, path: tuple[Array, Array], nearest: int) -> float:
    """The share of a view's points that lie within the picture of some pose of the path; occlusion is ignored.

    path: rotations [n, 3, 3] and centres [n, 3]. nearest: the pose of the path that is tried first, then those around
    it; what they see, nearly all of the view, is not tried on the rest of a long path.
    """
    rotations, centres = path
    sensor, k = camera.sensor, camera.intrinsics
    depth = camera.depth(pose[:3, :3], pose[:3, 3], undistorted=True)[::5, ::5].astype(np.float64)
    y, x = (np.mgrid[0 : sensor.height : 5, 0 : sensor.width : 5] + 0.5).reshape(2, *depth.shape)
    seen = np.isfinite(depth)
    rays = k.pinhole.unproject(np.stack([x, y], -1))[seen]
    points = pose[:3, 3] + (rays * depth[seen][:, None]) @ pose[:3, :3].T
    unseen, order = points, np.argsort(np.abs(np.arange(len(centres)) - nearest), kind="stable")
    while len(unseen) and len(order):
        count = max(_PAIRS // len(unseen), 1)
        poses, order = order[:count], order[count:]
        local = (unseen - centres[poses, None]) @ rotations[poses]
        u, v = np.moveaxis(k.project(local), -1, 0)
        inside = (local[..., 2] > 0) & (u >= 0) & (u < sensor.width) & (v >= 0) & (v < sensor.height)
        unseen = unseen[~inside.any(0)]
    return (len(points) - len(unseen)) / len(points) if len(points) else 0.0
