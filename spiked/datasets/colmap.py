"""Pictures with a COLMAP model: the layout of most sets for view synthesis, Tanks and Temples and Deblur-NeRF too."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from spiked.datasets.clip import PictureScene
from spiked.datasets.colmap_model import find_model, read_model
from spiked.datasets.kind import DatasetKind
from spiked.datasets.pictures import make_scene
from spiked.datasets.spikes import inside
from spiked.errors import DatasetError

LAYOUT = """
SCENE/images/*.png or *.jpg
SCENE/sparse/0/cameras.bin, images.bin, points3D.bin; or .txt; or in SCENE/sparse, in SCENE/colmap/sparse/0
SCENE may be the folder itself, or each of its folders
"""
_FOLDERS = ("images", "input", "rgb")
"""Names of the folder of pictures, in the order of preference."""


def scenes_in(folder: Path) -> Iterator[Path]:
    """Folders with a model: the folder itself, or those in it."""
    if find_model(folder) is not None:
        yield folder
        return
    yield from (child for child in sorted(folder.iterdir()) if child.is_dir() and find_model(child) is not None)


def recognises(folder: Path) -> bool:
    """Whether there is a model with a folder of pictures."""
    return any(_pictures(scene) is not None for scene in scenes_in(folder))


def read_scene(name: str, scene: Path) -> PictureScene:
    """The pictures of a scene that its model has poses of. Raises SceneError and DatasetError."""
    model_folder, pictures = find_model(scene), _pictures(scene)
    if model_folder is None or pictures is None:
        missing = "model (sparse/0)" if model_folder is None else f"folder of pictures ({', '.join(_FOLDERS)})"
        raise DatasetError(f"{scene} has no {missing}; copy the whole scene")
    model = read_model(model_folder)
    cameras = set(model.cameras)
    if len(cameras) > 1 and len({(c.width, c.height) for c in cameras}) > 1:
        raise DatasetError(f"{model_folder}: its pictures are of cameras of several sizes: a path has one camera")
    camera = model.cameras[len(model.cameras) // 2]
    if len(cameras) > 1:
        focal = float(np.median([c.intrinsics.fx for c in model.cameras]))
        camera = min(model.cameras, key=lambda c: abs(c.intrinsics.fx - focal))
    made = make_scene(
        name,
        [inside(pictures, file) for file in model.names],
        model.rotations,
        model.centres,
        (camera.width, camera.height, camera.intrinsics),
        median_depth=model.median_depth(),
    )
    parts = ("cameras", "images", "points3D")
    files = (model_folder / f"{part}{end}" for part in parts for end in (".bin", ".txt"))
    return replace(made, described_by=tuple(path for path in files if path.is_file()))


def read(folder: Path) -> tuple[PictureScene, ...]:
    """All scenes of a folder. Raises SceneError and DatasetError."""
    return tuple(read_scene(scene.name or "scene", scene) for scene in scenes_in(folder))


def _pictures(scene: Path) -> Path | None:
    return next((scene / name for name in _FOLDERS if (scene / name).is_dir()), None)


KIND = DatasetKind(
    name="colmap",
    title="Pictures with a COLMAP model",
    sensor="pictures of any camera; spikes are made of them",
    licence="that of the pictures",
    size="any",
    published="https://colmap.github.io/format.html (the format)",
    get="make it of your own pictures: colmap automatic_reconstructor --workspace_path SCENE --image_path SCENE/images",
    citation="J. Schoenberger and J.-M. Frahm, Structure-from-Motion Revisited, CVPR 2016",
    layout=LAYOUT,
    certainty="documented by COLMAP",
    recognises=recognises,
    read=read,
)
