"""What cleaning does to pictures off the path: reconstruction against the true scene, before and after.

`.venv/bin/python evaluation/cleaning_figures.py OUT TRUE_SCENE.ply TRUE_PATH.tum`
"""

import sys
from pathlib import Path

import numpy as np
from spiked_service.results.map_folder import MapFolder

from spiked.cleaning import FloaterRemoval, clean
from spiked.evaluate import Similarity, similarity_of_trajectories
from spiked.pose import Array
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.trajectory import Trajectory

VIEWS = 24
RATE_HZ = 20_000.0
"""Of the recordings."""
ASIDE = 0.15
"""How far off the path the views are, over the median depth there."""


def main(out: Path, true_scene: Path, true_path: Path) -> None:
    """Print the figures."""
    found, truth = MapFolder.read(out), Scene.read_ply(true_scene)
    path = Trajectory.read_tum(true_path)
    to_found = similarity_of_trajectories(truth=path, estimate=found.trajectory, frame_rate_hz=RATE_HZ)
    removed, cleaned = (
        clean(found.scene, found.trajectory, found.camera, removal=FloaterRemoval(split=split))
        for split in (False, True)
    )
    rasteriser = Rasteriser(found.camera)
    print(
        f"{len(found.scene)} splats, {cleaned.floaters} floaters, {cleaned.split} split, {cleaned.shrunk} shrunk, "
        f"{cleaned.large} left, "
        f"{len(cleaned.scene)} at the end"
    )
    for name, scene in (("before", found.scene), ("removed", removed.scene), ("split, too", cleaned.scene)):
        scores = [psnr_db(rasteriser, scene, truth, *pose, to_found) for pose in off_path(rasteriser, truth, path)]
        low, high = np.percentile(scene.means, (1, 99), axis=0)
        largest = 3 * float(np.exp(scene.log_scales.max())) / float(np.linalg.norm(high - low))
        print(f"{name}: off-path PSNR {np.mean(scores):.2f} dB, worst {min(scores):.2f} dB; largest {largest:.3f}")


def off_path(rasteriser: Rasteriser, truth: Scene, path: Trajectory) -> list[tuple[Array, Array]]:
    """True poses, moved to the four sides in turn."""
    poses = []
    for number, row in enumerate(np.linspace(0, len(path) - 1, VIEWS).astype(int)):
        rotation, centre = path.rotations[row], path.centres[row]
        image = rasteriser.forward(truth, rotation[None], centre[None])
        aside = ASIDE * float(np.median(image.depth[image.alpha > 0.5]))
        along = rotation[:, number % 2] * (1 if number % 4 < 2 else -1)
        poses.append((rotation, centre + aside * along))
    return poses


def psnr_db(
    rasteriser: Rasteriser, scene: Scene, truth: Scene, rotation: Array, centre: Array, to_found: Similarity
) -> float:
    """Of a picture of the scene against the true one, after the best gain, where the true scene is opaque."""
    wanted = rasteriser.forward(truth, rotation[None], centre[None])
    turned, moved = to_found.poses(rotation[None], centre[None])
    got = rasteriser.forward(scene, turned, moved)
    opaque = wanted.alpha > 0.95
    a, b = (image.values.reshape(*opaque.shape, -1).mean(axis=2)[opaque] for image in (wanted, got))
    white = np.percentile(a, 99.5)
    error = np.clip(b * (a @ b) / (b @ b), 0, white) - np.clip(a, 0, white)
    return float(-10 * np.log10(np.mean(error**2) / white**2))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
