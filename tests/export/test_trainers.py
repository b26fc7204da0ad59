"""What trainers of splats read of a COLMAP project and of a nerfstudio folder, of a reconstruction from spikes.

Each check names what of its loader needs it: `Parser` in gsplat's examples/datasets/colmap.py, and nerfstudio's
nerfstudio/data/dataparsers/nerfstudio_dataparser.py. Brush and OpenSplat read the same folders.
"""

import json
import subprocess
import sys
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from plyfile import PlyData

from spiked.trajectory import Trajectory

Array = NDArray[np.float64]
SIZE = (240, 160)
VIEWS = 12
GSPLAT_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"}
"""Camera models that gsplat's Parser knows; it stops at others."""
LENS = "opencv:-0.12,0.03,0.001,-0.001"


def spiked(*arguments: str | Path) -> None:
    subprocess.run([sys.executable, "-m", "spiked_service", *map(str, arguments)], check=True, capture_output=True)


@pytest.fixture(scope="module", params=["pinhole", "lens"])
def result(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a reconstruction of the simulated room."""
    folder = tmp_path_factory.mktemp(request.param)
    lens = ("--distortion", LENS) if request.param == "lens" else ()
    size = ("--width", f"{SIZE[0]}", "--height", f"{SIZE[1]}")
    spiked("simulate", "-o", folder / "room", "--motion", "arc", "--frames", "640", *size, *lens)
    spiked("reconstruct", folder / "room" / "simulated.dat", "-o", folder / "out", "--steps", "60")
    return folder / "out"


def pose_at(result: Path, name: str) -> tuple[Array, Array]:
    """Rotation and centre of the path at the time in the name of a picture."""
    path = Trajectory.read_tum(result / "trajectory.tum")
    row = int(np.argmin(np.abs(path.times_s - float(Path(name).stem))))
    return path.rotations[row], path.centres[row]


def assert_picture(path: Path) -> None:
    """A picture of the size of its camera, with three channels that loaders cut from it by [..., :3]."""
    picture = imageio.imread(path)
    assert picture.shape == (SIZE[1], SIZE[0], 3) and picture.dtype == np.uint8 and picture.std() > 10


def normalised(cameras: Array) -> Array:
    """Positions of cameras after gsplat's `normalize`: around their centre, in a ball of about 1."""
    centres = cameras[:, :3, 3]
    away = centres - np.median(centres, axis=0)
    return np.asarray(away / np.median(np.linalg.norm(away, axis=1)))


@pytest.mark.parametrize("undistorted", [False, True])
def test_gsplat_finds_what_its_parser_reads(result: Path, tmp_path: Path, undistorted: bool) -> None:
    spiked(
        "export", result, "colmap", "-o", tmp_path / "p", "--views", f"{VIEWS}", *["--undistorted"][: int(undistorted)]
    )
    model = pycolmap.Reconstruction(str(tmp_path / "p" / "sparse" / "0"))  # `sparse/0`, else `sparse`
    names = [image.name for image in model.images.values()]
    files = sorted(
        file.relative_to(tmp_path / "p" / "images").as_posix() for file in (tmp_path / "p" / "images").rglob("*")
    )
    assert len(names) == VIEWS and sorted(names) == files  # it pairs both lists by their order
    cameras = []
    errors = []
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert camera.model.name in GSPLAT_MODELS and (camera.width, camera.height) == SIZE
        assert camera.model.name == "PINHOLE" or not undistorted
        assert_picture(tmp_path / "p" / "images" / image.name)
        inverse = np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
        rotation, centre = pose_at(result, image.name)
        np.testing.assert_allclose(inverse[:3, :3], rotation, atol=1e-6)
        np.testing.assert_allclose(inverse[:3, 3], centre, atol=1e-6)
        cameras.append(inverse)
        k = camera.calibration_matrix()
        seen = image.get_observation_points2D()
        assert len(seen) > 20  # `load_depths` needs points in each picture
        points = np.stack([model.points3D[one.point3D_id].xyz for one in seen])
        local = (points - centre) @ rotation
        assert (local[:, 2] > 0).all()
        theirs = np.stack([image.project_point(point) for point in points])
        if camera.model.name == "PINHOLE":
            ours = local[:, :2] / local[:, 2:] @ k[:2, :2].T + k[:2, 2]
            assert np.abs(theirs - ours).max() < 0.1
        pixels = np.stack([one.xy for one in seen])
        assert ((pixels > 0) & (pixels < SIZE)).all()
        assert ((theirs > 0) & (theirs < SIZE)).all(axis=1).mean() > 0.98  # it leaves out those outside
        errors += [float(np.linalg.norm(one - point.xy)) for one, point in zip(theirs, seen, strict=True)]
    assert np.median(errors) <= 0.5
    points = list(model.points3D.values())
    colours = np.stack([point.color for point in points])
    assert len(points) > 100 and colours.dtype == np.uint8 and np.ptp(colours) > 50
    assert np.isfinite([point.error for point in points]).all() and max(point.error for point in points) < 5
    assert (
        np.abs(normalised(np.stack(cameras))).max() < 100 and np.ptp([point.xyz for point in points], axis=0).min() > 0
    )


def test_nerfstudio_finds_what_its_parser_reads(result: Path, tmp_path: Path) -> None:
    spiked("export", result, "nerfstudio", "-o", tmp_path / "n", "--views", f"{VIEWS}")
    meta = json.loads((tmp_path / "n" / "transforms.json").read_text())
    assert meta["camera_model"] in {"OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE"}
    assert (meta["w"], meta["h"]) == SIZE and type(meta["w"]) is int
    assert all(isinstance(meta[key], float) for key in ("fl_x", "fl_y", "cx", "cy"))
    lens = [meta.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    # Cameras and points are moved by the same matrix only if no further one is named.
    assert "applied_transform" not in meta and "applied_scale" not in meta
    table = PlyData.read(str(tmp_path / "n" / meta["ply_file_path"]))["vertex"].data
    points = np.stack([table[axis] for axis in "xyz"], 1).astype(float)
    assert {"red", "green", "blue"} <= set(table.dtype.names or ()) and len(points) > 100
    assert len(meta["frames"]) == VIEWS
    assert len({frame["file_path"] for frame in meta["frames"]}) == VIEWS
    for frame in meta["frames"]:
        assert_picture(tmp_path / "n" / frame["file_path"])
        pose = np.array(frame["transform_matrix"])
        assert pose.shape == (4, 4)
        rotation, centre = pose_at(result, frame["file_path"])
        np.testing.assert_allclose(pose[:3, :3] @ np.diag([1, -1, -1]), rotation, atol=1e-6)
        np.testing.assert_allclose(pose[:3, 3], centre, atol=1e-6)
        local = (points - centre) @ rotation
        assert (local[:, 2] > 0).mean() > 0.9
    assert any(lens) == ("lens" in str(result))


def test_both_folders_have_the_same_cameras_and_points(result: Path, tmp_path: Path) -> None:
    for name in ("colmap", "nerfstudio"):
        spiked("export", result, name, "-o", tmp_path / name, "--views", f"{VIEWS}")
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    meta = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())
    (camera,) = model.cameras.values()
    stated = [meta[key] for key in ("fl_x", "fl_y", "cx", "cy")]
    stated += [meta[key] for key in ("k1", "k2", "p1", "p2") if camera.model.name == "OPENCV"]
    np.testing.assert_allclose(camera.params, stated, rtol=1e-6)
    table = PlyData.read(str(tmp_path / "nerfstudio" / meta["ply_file_path"]))["vertex"].data
    points = np.stack([model.points3D[number].xyz for number in sorted(model.points3D)])
    np.testing.assert_allclose(np.stack([table[axis] for axis in "xyz"], 1), points, atol=1e-4)
