"""`spiked scale`, and what is stored of a scale."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from spiked_service.base.errors import BusyError
from spiked_service.cli.main import app
from spiked_service.results.scene_scale import MetricPoses, ScaleSource, SceneScale, read_scale, write_scale
from typer.testing import CliRunner

from spiked.errors import ConfigurationError, SceneError
from spiked.frame_of_reference import FrameOfReference
from spiked.poses import PoseAppender
from spiked.scene import Scene
from spiked.trajectory import Trajectory

from ..room_map import room_map


def run(*arguments: str | float | Path) -> Result:
    return CliRunner().invoke(app, ["scale", *map(str, arguments)])


def test_a_known_length_makes_metres(tmp_path: Path) -> None:
    out = room_map(2, (0.0, 0.5)).write(tmp_path / "out")
    done = run(out, "--length", "3.0", "1.5", "--up", "0", "0", "4")
    assert done.exit_code == 0, done.output
    assert "a unit is 2 m" in done.output
    own, path = Scene.read_ply(out / "scene.ply"), Trajectory.read_tum(out / "trajectory.tum")
    scene, metric = (
        Scene.read_ply(out / "metric" / "scene.ply"),
        Trajectory.read_tum(out / "metric" / "trajectory.tum"),
    )
    assert np.allclose(np.ptp(scene.means, axis=0)[1], 2 * np.ptp(own.means, axis=0)[2], rtol=1e-4)
    assert np.allclose(scene.log_scales - own.log_scales, np.log(2), atol=1e-5)
    assert scene.means[:, 1].max() <= 1e-3, "the floor of the room, z = 0, is at y = 0 and all else above it"
    assert np.allclose(
        np.linalg.norm(np.diff(metric.centres, axis=0), axis=1),
        2 * np.linalg.norm(np.diff(path.centres, axis=0), axis=1),
        atol=1e-6,
    )
    stored = read_scale(out)
    assert (stored.revision, stored.metres_per_unit, stored.source) == (1, 2.0, ScaleSource.LENGTH)
    assert stored.up == (0, 0, 1)


def test_up_is_found_by_the_floor_gravity_and_points(tmp_path: Path) -> None:
    out = room_map(2, (0.0, 0.4)).write(tmp_path / "out")
    done = run(out, "--floor")
    assert done.exit_code == 0, done.output
    assert "its scale is not known; up is" in done.output and not (out / "metric").exists()
    assert read_scale(out).up is not None and np.degrees(np.arccos(np.array(read_scale(out).up)[2])) < 1
    assert run(out, "--length", "3.0", "1.5", "--floor-points", "0,0,0 1,0,0 0,1,0").exit_code == 0
    assert read_scale(out).up == (0, 0, 1) and (out / "metric" / "scene.ply").exists()
    rotation = Trajectory.read_tum(out / "trajectory.tum").rotations[0]
    x, y, z = rotation.T @ [0, 0, -9.81]
    assert run(out, "--gravity", x, y, z).exit_code == 0
    stored = read_scale(out)
    assert stored.metres_per_unit == 2.0 and stored.up is not None
    assert np.allclose(stored.up, [0, 0, 1], atol=1e-6)
    assert "the nearest pose is at" in str(run(out, "--gravity", x, y, z, "--at", "99").exception)
    assert "write three points" in str(run(out, "--floor-points", "a,b,c").exception)
    assert "one of each" in str(run(out, "--floor", "--up", "0", "0", "1").exception)


def test_a_map_of_two_cameras_gets_metres_by_their_distance(tmp_path: Path) -> None:
    out = room_map(2, (0.0, 0.4)).write(tmp_path / "out")
    assert "the paths of two cameras, and this one has 1" in str(run(out, "--baseline", "0.12").exception)
    path = Trajectory.read_tum(out / "trajectory.tum")
    second = Trajectory(path.times_s, path.rotations, path.centres + path.rotations @ [0.4, 0, 0])
    (out / "paths").mkdir()
    path.write_tum(out / "paths" / "left.tum")
    second.write_tum(out / "paths" / "right.tum")
    report = json.loads((out / "report.json").read_text())
    report["paths"] = [{"name": "left"}, {"name": "right"}]
    (out / "report.json").write_text(json.dumps(report))
    done = run(out, "--baseline", "0.12")
    assert done.exit_code == 0, done.output + str(done.exception)
    stored = read_scale(out)
    assert stored.source is ScaleSource.BASELINE and stored.metres_per_unit == pytest.approx(0.3, rel=1e-4)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    out = room_map(2, (0.0,)).write(tmp_path / "out")
    assert isinstance(run(out).exception, ConfigurationError)
    assert "no tag is in any picture" in str(run(out, "--tag", "0.1").exception)
    assert isinstance(run(out, "--length", "3", "0").exception, ConfigurationError)


def test_a_scale_replaces_only_the_one_that_was_read(tmp_path: Path) -> None:
    first = write_scale(tmp_path, SceneScale(metres_per_unit=2.0), 0)
    assert first.revision == 1
    with pytest.raises(BusyError, match="revision 1 now, not 0"):
        write_scale(tmp_path, SceneScale(metres_per_unit=3.0), 0)
    assert read_scale(tmp_path).metres_per_unit == 2.0
    (tmp_path / "scale.json").write_text("{")
    with pytest.raises(SceneError, match="remove it"):
        read_scale(tmp_path)


def test_poses_are_read_in_metres(tmp_path: Path) -> None:
    turn = FrameOfReference(1.0, (0.3, 0.2, 0.9)).rotation
    path = Trajectory(np.arange(3.0), np.stack([np.eye(3), turn, turn @ turn]), np.eye(3))
    with PoseAppender(tmp_path / "a.poses") as file:
        file.append(path)
    frame = FrameOfReference(2.5, (0.3, -0.8, 0.1))
    got, wanted = MetricPoses(tmp_path / "a.poses", frame).trajectory(range(3)), frame.trajectory(path)
    assert np.allclose(got.centres, wanted.centres) and np.allclose(got.rotations, wanted.rotations)
    up = np.array(frame.up) / np.linalg.norm(frame.up)
    assert np.allclose(frame.rotation @ up, [0, -1, 0])
    assert np.allclose(FrameOfReference(1.0, (0.0, 1.0, 0.0)).rotation @ [0, 1, 0], [0, -1, 0])
