"""COLMAP projects and nerfstudio folders: their readers see the cameras, pictures and points that were exported."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from plyfile import PlyData

from spiked.distortion import Distortion
from spiked.export import ExportOptions, ExportSource, find_kind
from spiked.sensor import Intrinsics

OPTIONS = ExportOptions(views=6)
LENS = Distortion.parse("opencv:-0.1,0.02,0.001,-0.001")


@pytest.fixture(scope="module")
def project(source: ExportSource, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room as a COLMAP project."""
    folder = tmp_path_factory.mktemp("colmap")
    find_kind("colmap").write(source, folder, OPTIONS)
    return folder


def test_pycolmap_projects_points_to_the_pixels_where_pictures_show_them(source: ExportSource, project: Path) -> None:
    model = pycolmap.Reconstruction(str(project / "sparse" / "0"))
    assert model.num_reg_images() == 6 and model.num_points3D() > 100
    errors, checked = [], 0
    for image in model.images.values():
        row = int(np.argmin(np.abs(source.path.times_s - float(image.name.removesuffix(".png")))))
        rotation, centre = source.path.rotations[row], source.path.centres[row]
        pixels = cv2.imread(str(project / "images" / image.name), cv2.IMREAD_UNCHANGED)
        assert pixels.shape == (160, 240, 3) and pixels.std() > 10 and not np.ptp(pixels, axis=2).any()
        for point in image.get_observation_points2D():
            position = model.points3D[point.point3D_id].xyz
            theirs = image.project_point(position)
            assert source.sensor is not None and source.sensor.intrinsics is not None and theirs is not None
            ours = source.sensor.intrinsics.project((position - centre) @ rotation)
            assert np.abs(ours - theirs).max() < 0.1
            errors.append(np.linalg.norm(theirs - point.xy))
            checked += 1
    assert np.median(errors) < 0.5
    assert checked == model.compute_num_observations() and model.compute_mean_track_length() >= 3
    truth = np.mean([point.error for point in model.points3D.values()])
    model.update_point_3d_errors()
    assert np.mean([point.error for point in model.points3D.values()]) == pytest.approx(truth, abs=0.01)


def test_the_folder_has_what_loaders_of_gsplat_and_3dgs_look_for(project: Path) -> None:
    """gsplat's `datasets/colmap.py`: sparse/0, and for each name of an image a file in images/."""
    model = pycolmap.Reconstruction(str(project / "sparse" / "0"))
    named = sorted(image.name for image in model.images.values())
    assert named == sorted(file.name for file in (project / "images").iterdir())
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    assert all(len(point.track.elements) >= 3 for point in model.points3D.values())


def test_a_lens_is_kept_or_taken_out(source: ExportSource, tmp_path: Path) -> None:
    assert source.sensor is not None and source.sensor.intrinsics is not None
    bent = replace(source, sensor=replace(source.sensor, intrinsics=replace(source.sensor.intrinsics, distortion=LENS)))
    for name, options, model in (
        ("bent", OPTIONS, "OPENCV"),
        ("straight", replace(OPTIONS, undistorted=True), "PINHOLE"),
    ):
        (tmp_path / name).mkdir()
        find_kind("colmap").write(bent, tmp_path / name, replace(options, views=2))
        (camera,) = pycolmap.Reconstruction(str(tmp_path / name / "sparse" / "0")).cameras.values()
        assert camera.model.name == model
        k = Intrinsics(
            source.sensor.intrinsics.fx, source.sensor.intrinsics.fy, 120, 80, LENS if name == "bent" else None
        )
        ray = np.array([0.3, -0.2, 1.0])
        assert np.abs(camera.img_from_cam(ray) - k.project(ray)).max() < 0.1


def test_nerfstudio_finds_pictures_cameras_and_points(source: ExportSource, tmp_path: Path) -> None:
    """As `nerfstudio_dataparser.py` reads them: OpenGL cameras, file paths and a PLY beside transforms.json."""
    find_kind("nerfstudio").write(source, tmp_path, OPTIONS)
    index = json.loads((tmp_path / "transforms.json").read_text())
    assert index["camera_model"] == "OPENCV" and (index["w"], index["h"]) == (240, 160)
    table = PlyData.read(str(tmp_path / index["ply_file_path"]))["vertex"].data
    points = np.stack([table[name] for name in "xyz"], 1).astype(float)
    assert len(points) > 100 and table["red"].dtype == np.uint8
    for frame in index["frames"]:
        assert cv2.imread(str(tmp_path / frame["file_path"])).shape == (160, 240, 3)
        pose = np.array(frame["transform_matrix"])
        local = (points - pose[:3, 3]) @ pose[:3, :3] * [1, -1, -1]
        pixels = local[:, :2] / local[:, 2:] * [index["fl_x"], index["fl_y"]] + [index["cx"], index["cy"]]
        row = int(np.argmin(np.abs(source.path.centres - pose[:3, 3]).sum(1)))
        assert source.sensor is not None and source.sensor.intrinsics is not None
        ours = source.sensor.intrinsics.project((points - source.path.centres[row]) @ source.path.rotations[row])
        front = local[:, 2] > 0
        assert front.mean() > 0.9 and np.abs(ours - pixels)[front].max() < 0.1
