"""COLMAP on pictures made of spikes, in a process of its own.

pycolmap brings its own OpenMP and BLAS, which must not meet those of OpenCV and torch in one process. Its working
folder is an ordinary COLMAP project: `images/`, `sparse/0`.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel

from spiked.baselines.pictures import SpikePicture
from spiked.errors import ConfigurationError, SceneError
from spiked.pose import Array
from spiked.sensor import Intrinsics
from spiked.trajectory import colmap_lens

__all__ = ["ColmapResult", "run_colmap"]

_TAIL = 400
"""Characters of COLMAP's own messages in an error."""


class ColmapTask(BaseModel):
    """What the process is asked for."""

    folder: Path
    model: str
    """COLMAP's name of the camera model."""
    parameters: list[float]
    threads: int
    seed: int
    parent: int
    """Process that asks; the one that is asked ends with it."""


class ColmapPoses(BaseModel):
    """What it answers: the poses of the largest model."""

    version: str
    models: int
    names: list[str]
    rotations: list[list[list[float]]]
    """World to camera."""
    translations: list[list[float]]
    points: int
    reprojection_px: float


@dataclass(frozen=True)
class ColmapResult:
    """The largest model that COLMAP found, at the pictures that it registered."""

    times: Array
    """[n] in frames, increasing."""
    rotations: Array
    """[n, 3, 3], camera to world."""
    centres: Array
    """[n, 3]."""
    points: int
    reprojection_px: float
    models: int
    """Models that COLMAP made; more than one means that it could not join all pictures."""
    version: str


def run_colmap(
    pictures: Sequence[SpikePicture], intrinsics: Intrinsics, folder: Path, *, threads: int | None = None, seed: int = 0
) -> ColmapResult:
    """Poses of the pictures by incremental structure from motion with the intrinsics held.

    The pictures and the model stay in `folder`. Raises ConfigurationError without pycolmap, and SceneError where
    COLMAP finds no model.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise ConfigurationError("COLMAP is not installed: install spiked with the extra 'colmap', which has pycolmap")
    if (folder / "images").is_dir():
        shutil.rmtree(folder / "images")  # COLMAP reads all pictures there
    (folder / "images").mkdir(parents=True)
    for number, picture in enumerate(pictures):
        (folder / "images" / _name(number)).write_bytes(cv2.imencode(".png", picture.pixels)[1].tobytes())
    model, lens = colmap_lens(intrinsics.distortion)
    parameters = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, *lens.values()]
    threads = threads or len(os.sched_getaffinity(0))
    task = ColmapTask(
        folder=folder.absolute(), model=model, parameters=parameters, threads=threads, seed=seed, parent=os.getpid()
    )
    found = _in_a_process(task)
    if not found.names:
        raise SceneError(
            f"COLMAP registered none of {len(pictures)} pictures: they show too few features or too little parallax; "
            "try another kind of images or longer windows"
        )
    return _result(found, pictures)


def _in_a_process(task: ColmapTask) -> ColmapPoses:
    command = [sys.executable, "-m", "spiked.baselines.colmap_process", task.model_dump_json()]
    environment = os.environ | {"OMP_NUM_THREADS": str(task.threads), "PYTHONSAFEPATH": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    answer = task.folder / "poses.json"
    if done.returncode != 0 or not answer.exists():
        raise SceneError(f"COLMAP failed with status {done.returncode}: {done.stderr.strip()[-_TAIL:]}")
    found = ColmapPoses.model_validate(json.loads(answer.read_bytes()))
    answer.unlink()
    return found


def _result(found: ColmapPoses, pictures: Sequence[SpikePicture]) -> ColmapResult:
    order = np.argsort(found.names)
    to_camera, translations = np.array(found.rotations)[order], np.array(found.translations)[order]
    rotations = to_camera.swapaxes(1, 2)
    return ColmapResult(
        times=np.array([pictures[int(Path(found.names[row]).stem)].time for row in order]),
        rotations=rotations,
        centres=-np.einsum("nij,nj->ni", rotations, translations),
        points=found.points,
        reprojection_px=found.reprojection_px,
        models=found.models,
        version=found.version,
    )


def _name(number: int) -> str:
    return f"{number:05d}.png"
