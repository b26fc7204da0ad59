"""Compare reconstructions through a lens with the truth, in the lens's own pixels and without distortion.

    .venv/bin/python evaluation/measure_lens.py FOLDER=RESULT ...

FOLDER: a recording of `spiked simulate` with its truth. RESULT: that of `spiked reconstruct`. A row of the table
has the mean PSNR of the held-out views, of those on the path and beside it, of the worst, and of the pixels of those on
the path between the angles `RINGS_DEG` from the optical axis. `undistorted`: pictures of a pinhole camera, as `spiked
evaluate` scores them. `lens`: pictures of the lens itself. `true lens picture, undistorted`: exact pictures of the
lens, resampled to those of the pinhole camera and compared with the exact ones: what one picture through this lens
knows of the undistorted view.
"""

import argparse
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.evaluate import best_gain, psnr, refine_pose, similarity_of_trajectories
from spiked.recording import open_recording
from spiked.render import Camera
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory
from spiked.undistortion import Undistortion

Array = NDArray[np.float64]
Picture = NDArray[np.float32]

RINGS_DEG = 0, 15, 25, 35, 46, 80
"""Lenses of 60 to 120 degrees have the scene within 25 degrees in common, in pixels of nearly the same angle."""


def picture(path: Path) -> Picture:
    """A held-out view, 1 is white."""
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.float32) / np.float32(255)


def renderer(scene: Scene, camera: Camera) -> Callable[[Array, Array], Picture]:
    """Pictures of a grey scene from camera-to-world poses."""
    rasteriser = Rasteriser(camera)
    return lambda rotation, centre: rasteriser.forward(scene, rotation[None], centre[None]).values


def rings(optics: Intrinsics, width: int, height: int) -> list[NDArray[np.bool_]]:
    """The pixels [H, W] of each ring around the axis."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    rays = optics.unproject(np.stack([x, y], -1))
    angles = np.degrees(np.arctan(np.hypot(rays[..., 0], rays[..., 1])))
    return [(angles >= low) & (angles < high) for low, high in itertools.pairwise(RINGS_DEG)]


def row(name: str, pairs: list[tuple[Picture, Picture]], on_path: list[bool], parts: list[NDArray[np.bool_]]) -> str:
    """All, on the path, beside it, worst, and each of the parts on the path; nothing where a camera sees none of it."""
    db, on = np.array([psnr(a, b) for a, b in pairs]), np.array(on_path)
    along = [pair for pair, chosen in zip(pairs, on_path, strict=True) if chosen]
    inside = [np.mean([psnr(a[part], b[part]) for a, b in along]) if part.any() else None for part in parts]
    cells = (db.mean(), db[on].mean(), db[~on].mean(), db.min(), *inside)
    return f"| {name} | " + " | ".join("" if value is None else f"{value:.2f}" for value in cells) + " |"


def measure(folder: Path, result: Path) -> list[str]:
    """The rows of one reconstruction."""
    recording = open_recording(next(folder.glob("*.dat")))
    sensor = recording.sensor
    assert sensor.intrinsics is not None and sensor.mosaic is None
    table: dict[str, Any] = json.loads((folder / "views.json").read_text())
    views, on_path = table["views"], [view["on_trajectory"] for view in table["views"]]
    similarity = similarity_of_trajectories(
        truth=Trajectory.read_tum(folder / "groundtruth.tum"),
        estimate=Trajectory.read_tum(result / "trajectory.tum"),
        frame_rate_hz=sensor.frame_rate_hz,
    )
    matrices = [np.array(view["c2w"]) for view in views]
    poses = [similarity.poses(matrix[:3, :3], matrix[:3, 3]) for matrix in matrices]
    scene, length = Scene.read_ply(result / "scene.ply"), similarity.scale * table["median_depth"]

    def shown(optics: Intrinsics, key: str) -> list[tuple[Picture, Picture]]:
        render = renderer(scene, Camera(optics, sensor.width, sensor.height))
        truths = [picture(folder / view[key]) for view in views]
        gain = best_gain([render(*pose) for pose in poses], truths=truths)
        refined = [
            render(*refine_pose(render, pose, truth=truth, gain=gain, length=length))
            for pose, truth in zip(poses, truths, strict=True)
        ]
        gain = best_gain(refined, truths=truths)
        return [(np.clip(gain * image, 0, 1), truth) for image, truth in zip(refined, truths, strict=True)]

    optics, size = sensor.intrinsics, (sensor.width, sensor.height)
    straight = rings(optics.pinhole, *size)
    rows = [row(f"{folder.name}: undistorted", shown(optics.pinhole, "file"), on_path, straight)]
    if optics.distortion is not None:
        rows.append(row(f"{folder.name}: lens", shown(optics, "lens_file"), on_path, rings(optics, *size)))
        undistortion = Undistortion.of(optics, *size)
        exact = [picture(folder / view["file"]) for view in views]
        seen = undistortion.straighten(np.ones(size[::-1], np.float32)) > 0
        resampled = [undistortion.straighten(picture(folder / view["lens_file"])) * seen for view in views]
        bound = [(image, truth * seen) for image, truth in zip(resampled, exact, strict=True)]
        rows.append(row(f"{folder.name}: true lens picture, undistorted", bound, on_path, straight))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", metavar="FOLDER=RESULT")
    names = [f"{low} to {high} degrees" for low, high in itertools.pairwise(RINGS_DEG)]
    print("| pictures | PSNR dB | on the path | beside it | worst | " + " | ".join(names) + " |")
    print("|" + "---|" * (5 + len(names)))
    for pair in parser.parse_args().pairs:
        folder, _, result = pair.partition("=")
        print("\n".join(measure(Path(folder), Path(result))), flush=True)


if __name__ == "__main__":
    main()
