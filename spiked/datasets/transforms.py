"""Pictures with `transforms.json`: the layout of nerfstudio and instant-ngp, and of Blender's synthetic scenes."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from spiked.datasets.clip import PictureScene
from spiked.datasets.kind import DatasetKind
from spiked.datasets.pictures import make_scene, picture_size
from spiked.datasets.spikes import PICTURE_SUFFIXES, inside
from spiked.errors import DatasetError, SceneError
from spiked.natural_order import natural
from spiked.sensor import Intrinsics
from spiked.transforms import Transforms

FILE = "transforms.json"
_SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
"""Of Blender's scenes; together they are one scene."""


def scenes_in(folder: Path) -> Iterator[Path]:
    """Folders with such a file: the folder itself, or those in it."""
    if _files(folder):
        yield folder
        return
    yield from (child for child in sorted(folder.iterdir()) if child.is_dir() and _files(child))


def recognises(folder: Path) -> bool:
    """Whether there is a scene without clips of spikes beside it."""
    return any(not (scene / "spike_data").is_dir() for scene in scenes_in(folder))


def read_scene(name: str, scene: Path) -> PictureScene:
    """A scene of `transforms.json`, or of the files of a split. Raises SceneError and DatasetError."""
    pictures: list[Path] = []
    matrices, times = [], []
    camera = None
    for path in _files(scene):
        content = Transforms.read(path)
        found = [_picture(scene, frame.file_path) for frame in content.frames]
        matrices.append(content.poses(path))
        times += [frame.time for frame in content.frames]
        own = _camera(content, path, found[0])
        if camera is not None and own != camera:
            raise DatasetError(f"{path}: its camera is another one than that of the files before; separate the scenes")
        camera = own
        pictures += found
    if camera is None:
        raise DatasetError(f"{scene} has no {FILE}")
    poses = np.concatenate(matrices)
    stated = None if None in times else np.array(times, np.float64)
    if stated is not None and len(np.unique(stated)) < len(stated):
        stated = None  # times of Blender's scenes are all 0
    made = make_scene(name, pictures, poses[:, :3, :3], poses[:, :3, 3], camera, times_s=stated)
    return replace(made, described_by=tuple(_files(scene)))


def read(folder: Path) -> tuple[PictureScene, ...]:
    """All scenes of a folder. Raises SceneError and DatasetError."""
    return tuple(read_scene(scene.name or "scene", scene) for scene in sorted(scenes_in(folder), key=natural))


def _camera(content: Transforms, path: Path, first: Path) -> tuple[int, int, Intrinsics]:
    """Width, height and intrinsics; sizes that are not stated are those of the first picture. Raises SceneError."""
    size = (content.w, content.h) if content.w and content.h else picture_size(first)
    intrinsics = content.intrinsics(path, size)
    if intrinsics is None:
        raise SceneError(f"{path}: neither fl_x nor camera_angle_x is stated: the focal length is unknown")
    return *size, intrinsics


def _files(scene: Path) -> list[Path]:
    if (scene / FILE).is_file():
        return [scene / FILE]
    return [scene / name for name in _SPLITS if (scene / name).is_file()]


def _picture(scene: Path, name: str) -> Path:
    """The file of a picture, whose name in Blender's scenes has no ending. Raises DatasetError."""
    path = inside(scene, name)
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return path
    return next((found for end in PICTURE_SUFFIXES if (found := Path(f"{path}{end}")).is_file()), path)


KIND = DatasetKind(
    name="transforms",
    title="Pictures with transforms.json (nerfstudio, instant-ngp, Blender)",
    sensor="pictures of any camera; spikes are made of them",
    licence="that of the pictures",
    size="any",
    published="https://docs.nerf.studio/quickstart/data_conventions.html (the format)",
    get="make it of your own pictures: ns-process-data images --data PICTURES --output-dir SCENE",
    citation="M. Tancik et al., Nerfstudio: A Modular Framework for Neural Radiance Field Development, SIGGRAPH 2023",
    layout="""
SCENE/transforms.json, or transforms_train.json, transforms_val.json, transforms_test.json
SCENE/images/*.png or wherever file_path says
SCENE may be the folder itself, or each of its folders
""",
    certainty="documented by nerfstudio",
    recognises=recognises,
    read=read,
)
