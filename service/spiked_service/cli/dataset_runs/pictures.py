"""Pictures of a data set handed to `spiked simulate --video`: a folder of links, with times and poses."""

import json
from pathlib import Path

import numpy as np

from spiked.datasets import PictureScene
from spiked.distortion import LensModel
from spiked.errors import DatasetError

PICTURE_RATE_HZ = 960.0
"""Pictures a second where the data set has no times: that of the fastest common cameras."""
VIEWS = 8
"""Pictures that are compared with renders of the scene."""


def simulation_arguments(scene: PictureScene, folder: Path, out: Path, name: str, options: list[str]) -> list[str]:
    """Arguments of `spiked` that make the recording of a scene in `out`; `options` overrule those that are chosen here.

    Makes `folder` with the pictures. Raises DatasetError.
    """
    poses = link_pictures(scene, folder)
    arguments = ["simulate", "--video", str(folder), "--poses", str(poses), "-o", str(out), "--name", name]
    if scene.times_s is None:
        arguments += ["--picture-rate", f"{PICTURE_RATE_HZ:g}"]
    return [*arguments, "--views", str(VIEWS), *options]


def link_pictures(scene: PictureScene, folder: Path) -> Path:
    """Make a folder with the pictures of a scene as links, numbered in the order of the path, and their times if known.

    Returns the path of a transforms.json with poses and optics. Raises DatasetError.
    """
    names = [f"{number:06d}{picture.suffix.lower()}" for number, picture in enumerate(scene.pictures)]
    try:
        folder.mkdir(parents=True)
        for name, picture in zip(names, scene.pictures, strict=True):
            (folder / name).symlink_to(picture.resolve())
        if scene.times_s is not None:
            rows = zip(scene.times_s, names, strict=True)
            (folder / "times.txt").write_text("".join(f"{time:.9f} {name}\n" for time, name in rows), "utf-8")
        poses = folder / "transforms.json"
        poses.write_text(json.dumps(_transforms(scene, names)), "utf-8")
    except OSError as error:
        raise DatasetError(f"{folder} cannot be made: {error.strerror}; name another place with -o") from error
    return poses


def _transforms(scene: PictureScene, names: list[str]) -> dict[str, object]:
    """In nerfstudio's form: camera to world, OpenGL's axes."""
    k = scene.intrinsics
    fisheye = k.distortion is not None and k.distortion.model is LensModel.FISHEYE
    optics = {"w": scene.width, "h": scene.height, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy}
    lens = {} if k.distortion is None else k.distortion.named()
    matrices = scene.trajectory(PICTURE_RATE_HZ).matrices() @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [{"file_path": name, "transform_matrix": m.tolist()} for name, m in zip(names, matrices, strict=True)]
    return {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV", **optics, **lens, "frames": frames}
