"""Accuracy of exports against a scene of the truth: depth maps, points and the mesh (decision 43).

Usage: python evaluation/export_figures.py OUT RECORDING_FOLDER SCENE.ply

OUT is the output folder of `spiked reconstruct`, RECORDING_FOLDER has groundtruth.tum and the sidecar of the recording,
SCENE.ply is the scene that was rendered. The result is brought into the frame of the truth by aligning its path, with
one scale. F-scores are at 1 % of the longest side of the box that holds 98 % of the true points.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from spiked_service.results.report.folder import FolderReport

from spiked.evaluate import similarity_of_trajectories
from spiked.export import ExportOptions, ExportSource
from spiked.export.mesh import mesh_of
from spiked.export.source import camera_of
from spiked.export.surface import fused
from spiked.export.views import RenderedView, rendered, rendered_views
from spiked.recording import read_sidecar
from spiked.render import rasteriser_for
from spiked.scene import Scene
from spiked.trajectory import Trajectory

Doubles = NDArray[np.float64]
SAMPLES = 200_000
"""Points of a mesh or of the truth that distances are measured from."""


def truth_of(source: ExportSource, folder: Path, scene: Path) -> ExportSource:
    """The truth at the times of the result."""
    sensor = read_sidecar(next(folder.glob("*.json"))).sensor() if source.recording is None else source.recording.sensor
    path = Trajectory.read_tum(folder / "groundtruth.tum")
    rows = path.nearest(source.path.times_s, 0.6 / sensor.frame_rate_hz)
    path = Trajectory(source.path.times_s, path.rotations[rows], path.centres[rows])
    return ExportSource(path, replace(sensor, intrinsics=sensor.intrinsics), Scene.read_ply(scene))


def true_views(truth: ExportSource, kind: Literal["median", "expected"]) -> Iterator[RenderedView]:
    """The key views of the truth."""
    assert truth.scene is not None and truth.sensor is not None
    camera = camera_of(truth.sensor)
    rasteriser = rasteriser_for(camera)
    for row in truth.key_rows(ExportOptions()):
        pose = truth.path.rotations[row], truth.path.centres[row]
        colour, depth = rendered(rasteriser, truth.scene, *pose, kind)
        yield RenderedView(row, float(truth.path.times_s[row]), camera, *pose, colour, depth)


def depth_errors(source: ExportSource, truth: ExportSource, scale: float) -> None:
    """Print the errors of both kinds of depth against both kinds of the truth."""
    kinds: tuple[Literal["median", "expected"], ...] = ("median", "expected")
    true = {kind: list(true_views(truth, kind)) for kind in kinds}
    for kind in kinds:
        views = list(rendered_views(source, ExportOptions(depth=kind)))
        for against in kinds:
            errors, own = [], []
            for view, other in zip(views, true[against], strict=True):
                both = (view.depth > 0) & (other.depth > 0)
                ratio = view.depth[both] / other.depth[both]
                errors.append(np.abs(scale * ratio - 1))
                own.append(np.abs(ratio / np.median(ratio) - 1))
            error, relative = np.concatenate(errors), np.concatenate(own)
            print(
                f"{kind} depth against the {against} of the truth: median {np.median(error):.3%}, "
                f"90 % below {np.percentile(error, 90):.2%}; with the scale of each view {np.median(relative):.3%}"
            )


def f_score(found: Doubles, true: Doubles, threshold: float) -> tuple[float, float, float]:
    """Precision, recall and their harmonic mean."""
    precision = float((cKDTree(true).query(found)[0] < threshold).mean())
    recall = float((cKDTree(found).query(true)[0] < threshold).mean())
    return precision, recall, 2 * precision * recall / max(precision + recall, 1e-12)


def main() -> None:
    """Print the figures."""
    import trimesh

    result, folder, scene = (Path(argument) for argument in sys.argv[1:4])
    source = FolderReport(result).export_source()
    truth = truth_of(source, folder, scene)
    assert source.sensor is not None
    # It takes what it calls the truth to the other one.
    similarity = similarity_of_trajectories(
        truth=source.path, estimate=truth.path, frame_rate_hz=source.sensor.frame_rate_hz
    )
    print(f"{result}: scale {similarity.scale:.5f}")
    depth_errors(source, truth, similarity.scale)
    true = fused(truth, list(true_views(truth, "median")), 256)
    low, high = true.extent()
    threshold = 0.01 * float((high - low).max())
    rng = np.random.default_rng(0)
    wanted = true.positions[rng.permutation(len(true))[:SAMPLES]]
    points = fused(source, list(rendered_views(source, ExportOptions())), 256)
    some = similarity.points(points.positions[rng.permutation(len(points))[:SAMPLES]])
    print("points: precision {:.3f}, recall {:.3f}, F {:.3f}".format(*f_score(some, wanted, threshold)))
    mesh = mesh_of(source, ExportOptions())
    sampled, _ = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces), SAMPLES, seed=0)
    print(
        "mesh: precision {:.3f}, recall {:.3f}, F {:.3f}".format(
            *f_score(similarity.points(sampled), wanted, threshold)
        )
    )


if __name__ == "__main__":
    main()
