"""The process that imports pycolmap: `python -m spiked.baselines.colmap_process TASK`, a `ColmapTask` as JSON.

Writes `poses.json` and the largest model as `sparse/0` to the task's folder.
"""

import shutil
import sys
from pathlib import Path
from typing import Any

import pycolmap

from spiked.baselines.colmap import ColmapPoses, ColmapTask
from spiked.lifetime import end_with

EXHAUSTIVE_PICTURES = 80
"""Up to this many pictures every pair is matched; of more, each with its neighbours."""
NEIGHBOURS = 20
"""Pictures on either side, with those at 2, 4, 8, ... times the distance."""
TRIANGULATION_DEG = (16.0, 8.0, 4.0, 2.0)
"""Least angles of the first pair, tried one after another: COLMAP's own, and those of hands that hardly move."""


def main() -> None:
    """Carry out the task of the command line."""
    task = ColmapTask.model_validate_json(sys.argv[1])
    end_with(task.parent)
    pycolmap.logging.minloglevel = 2  # errors
    pycolmap.set_random_seed(task.seed)
    database = task.folder / "database.db"
    database.unlink(missing_ok=True)
    _match(task, database)
    models = next((found for angle in TRIANGULATION_DEG if (found := _map(task, database, angle))), {})
    database.unlink()
    (task.folder / "poses.json").write_text(_poses(task, models).model_dump_json(), encoding="utf-8")


def _match(task: ColmapTask, database: Path) -> None:
    reader = pycolmap.ImageReaderOptions(
        camera_model=task.model, camera_params=",".join(f"{number:.9g}" for number in task.parameters)
    )
    extraction = pycolmap.FeatureExtractionOptions(num_threads=task.threads, use_gpu=False)
    pycolmap.extract_features(
        database,
        task.folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching = pycolmap.FeatureMatchingOptions(num_threads=task.threads, use_gpu=False)
    if len(list((task.folder / "images").iterdir())) <= EXHAUSTIVE_PICTURES:
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
        return
    pairing = pycolmap.SequentialPairingOptions(overlap=NEIGHBOURS)
    pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu)


def _map(task: ColmapTask, database: Path, angle_deg: float) -> dict[int, Any]:
    """Models of the pictures, with the first pair at an angle of at least `angle_deg`."""
    options = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
        num_threads=task.threads,
        random_seed=task.seed,
    )
    options.mapper.init_min_tri_angle = angle_deg
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    out = task.folder / "sparse"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    return dict(pycolmap.incremental_mapping(database, task.folder / "images", out, options))


def _poses(task: ColmapTask, models: dict[int, Any]) -> ColmapPoses:
    out = task.folder / "sparse"
    shutil.rmtree(out, ignore_errors=True)
    version = str(pycolmap.__version__)
    if not models:
        return ColmapPoses(
            version=version, models=0, names=[], rotations=[], translations=[], points=0, reprojection_px=0.0
        )
    largest = max(models.values(), key=lambda model: int(model.num_reg_images()))
    (out / "0").mkdir(parents=True)
    largest.write(out / "0")
    images = [largest.images[number] for number in largest.reg_image_ids()]
    poses = [image.cam_from_world() for image in images]
    return ColmapPoses(
        version=version,
        models=len(models),
        names=[image.name for image in images],
        rotations=[pose.rotation.matrix().tolist() for pose in poses],
        translations=[pose.translation.tolist() for pose in poses],
        points=int(largest.num_points3D()),
        reprojection_px=float(largest.compute_mean_reprojection_error()),
    )


if __name__ == "__main__":
    main()
