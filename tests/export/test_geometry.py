"""Depth maps, points and meshes: other programs' readers see the room where it is."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
import trimesh
from plyfile import PlyData

from spiked.errors import SceneError
from spiked.export import ExportOptions, ExportSource, find_kind
from spiked.simulate import Room
from spiked.simulate.motion import hand_shake
from spiked.trajectory import Trajectory

from ..room_map import OPTICS, SENSOR

OPTIONS = ExportOptions(views=4, resolution=96)


def true_depth(source: ExportSource, time_s: float) -> np.ndarray:
    row = int(np.argmin(np.abs(source.path.times_s - time_s)))
    view = Room(seed=3).render(
        OPTICS, SENSOR.width, SENSOR.height, source.path.rotations[row], source.path.centres[row]
    )
    return np.asarray(view.depth)


def test_depth_maps_have_the_depth_and_the_normals_of_the_room(source: ExportSource, tmp_path: Path) -> None:
    assert find_kind("depth").write(source, tmp_path, OPTIONS) == "4 depth and normal maps"
    index = json.loads((tmp_path / "depth.json").read_text())
    for frame in index["frames"]:
        exr = oiio.ImageBuf(str(tmp_path / frame["depth_exr"])).get_pixels(oiio.FLOAT)[..., 0]
        png = cv2.imread(str(tmp_path / frame["depth_png"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(png * index["depth_png_unit"], exr, atol=0.51 * index["depth_png_unit"])
        truth = true_depth(source, frame["time_s"])
        known = exr > 0
        assert known.mean() > 0.4
        assert np.median(np.abs(exr / truth - 1)[known]) < 0.005
        normals = oiio.ImageBuf(str(tmp_path / frame["normal_exr"])).get_pixels(oiio.FLOAT)
        lengths = np.linalg.norm(normals, axis=2)
        some = lengths > 0
        np.testing.assert_allclose(lengths[some], 1, atol=1e-5)
        rays = OPTICS.unproject(np.stack(np.meshgrid(np.arange(240) + 0.5, np.arange(160) + 0.5), -1))
        assert ((normals * rays).sum(-1)[some] < 0).mean() > 0.999  # towards the camera


def test_depth_of_any_frame_is_that_of_the_room_also_between_poses(source: ExportSource, tmp_path: Path) -> None:
    """Poses are those of every fourth frame; the truth is the camera's own path."""
    frames = (40, 41, 203)
    find_kind("depth").write(source, tmp_path, ExportOptions(frames=frames))
    index = json.loads((tmp_path / "depth.json").read_text())
    motion = hand_shake(Room(seed=3).stage(OPTICS, flow_px=0.15), 3)
    for frame, given in zip(frames, index["frames"], strict=True):
        assert given["time_s"] == pytest.approx((frame + 0.5) / SENSOR.frame_rate_hz, abs=1e-9)
        (rotation,), (centre,) = motion.poses(np.array([frame + 0.5]))
        pose = np.array(given["camera_to_world"])
        np.testing.assert_allclose(pose[:3, :3], rotation, atol=2e-5)
        np.testing.assert_allclose(pose[:3, 3], centre, atol=2e-5)
        truth = Room(seed=3).render(OPTICS, SENSOR.width, SENSOR.height, rotation, centre).depth
        depth = oiio.ImageBuf(str(tmp_path / given["depth_exr"])).get_pixels(oiio.FLOAT)[..., 0]
        known = depth > 0
        assert known.mean() > 0.4 and np.median(np.abs(depth / truth - 1)[known]) < 0.005
        normals = oiio.ImageBuf(str(tmp_path / given["normal_exr"])).get_pixels(oiio.FLOAT) @ rotation.T
        floor = (np.linalg.norm(normals, axis=2) > 0) & (np.abs(height_of(truth, rotation, centre)) < 1e-3)
        assert floor.sum() > 200 and np.median(normals[floor][:, 2]) > 0.99  # straight up


def height_of(depth: np.ndarray, rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """z of what the pixels see, [H, W]."""
    rays = OPTICS.unproject(np.stack(np.meshgrid(np.arange(240) + 0.5, np.arange(160) + 0.5), -1))
    return np.asarray(((rays * depth[..., None]) @ rotation.T + centre)[..., 2])


def test_a_frame_without_a_pose_is_refused(source: ExportSource, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="frame 999 of room has no pose; there are poses from 0 to 396"):
        find_kind("depth").write(source, tmp_path / "out", ExportOptions(frames=(999,)))


def test_a_frame_inside_a_gap_is_refused_with_the_gap(source: ExportSource, tmp_path: Path) -> None:
    path = source.path
    late = np.where(np.arange(len(path)) < 50, 0.0, 0.1)
    gap = replace(source, path=Trajectory(path.times_s + late, path.rotations, path.centres))
    with pytest.raises(SceneError, match="frame 1000 of room has no pose; there are none between 196 and 2200"):
        find_kind("depth").write(gap, tmp_path / "out", ExportOptions(frames=(1000,)))


def test_frames_that_are_given_twice_and_in_any_order_are_taken_once_in_their_order(source: ExportSource) -> None:
    times = [pose.time_s * SENSOR.frame_rate_hz for pose in source.key_poses(ExportOptions(frames=(203, 40, 203, 41)))]
    assert np.allclose(times, [40.5, 41.5, 203.5])


def test_points_lie_on_the_walls_and_look_inwards(source: ExportSource, tmp_path: Path) -> None:
    find_kind("points-ply").write(source, tmp_path / "points.ply", OPTIONS)
    table = PlyData.read(str(tmp_path / "points.ply"))["vertex"].data
    points = np.stack([table[name] for name in "xyz"], 1).astype(float)
    local = (points - source.path.centres[0]) @ source.path.rotations[0]
    x, y = OPTICS.project(local).T
    inside = (x > 0) & (y > 0) & (x < 240) & (y < 160)
    expected = true_depth(source, float(source.path.times_s[0]))[y[inside].astype(int), x[inside].astype(int)]
    off = np.abs(local[inside, 2] / expected - 1)
    assert len(points) > 5000 and np.median(off) < 0.005
    normals = np.stack([table[f"n{name}"] for name in "xyz"], 1)
    assert ((normals * (source.path.centres[0] - points)).sum(1) > 0).mean() > 0.99
    grey = table["red"].astype(int)
    assert grey.std() > 10 and (grey == table["blue"]).all()


def test_pcd_has_the_values_of_the_ply(source: ExportSource, tmp_path: Path) -> None:
    for kind in ("points-ply", "points-pcd"):
        find_kind(kind).write(source, tmp_path / kind, OPTIONS)
    table = PlyData.read(str(tmp_path / "points-ply"))["vertex"].data
    raw = (tmp_path / "points-pcd").read_bytes()
    head, body = raw.split(b"DATA binary\n", 1)
    assert f"POINTS {len(table)}\n".encode() in head and b"FIELDS x y z normal_x normal_y normal_z rgb\n" in head
    rows = np.frombuffer(body, np.dtype([("numbers", "<f4", 6), ("rgb", "<u4")]))
    np.testing.assert_array_equal(rows["numbers"][:, 0], table["x"])
    np.testing.assert_array_equal(rows["rgb"] >> 16, table["red"])


@pytest.mark.parametrize("kind", ["mesh-ply", "mesh-glb"])
def test_the_mesh_is_the_surface_of_the_points(source: ExportSource, tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"mesh{find_kind(kind).suffix}"
    find_kind(kind).write(source, file, OPTIONS)
    mesh = trimesh.load(str(file), force="mesh")
    local = (np.asarray(mesh.vertices) - source.path.centres[0]) @ source.path.rotations[0]
    x, y = OPTICS.project(local).T
    inside = (x > 0) & (y > 0) & (x < 240) & (y < 160)
    expected = true_depth(source, float(source.path.times_s[0]))[y[inside].astype(int), x[inside].astype(int)]
    assert len(mesh.faces) > 2000 and np.median(np.abs(local[inside, 2] / expected - 1)) < 0.01
    towards = (mesh.face_normals * (source.path.centres[0] - mesh.triangles_center)).sum(1)
    assert (towards > 0).mean() > 0.95
    assert mesh.visual.vertex_colors[:, 0].std() > 10
