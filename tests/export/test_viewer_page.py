"""The page with a viewer holds the scene and the path, and asks nothing of a network."""

import base64
import gzip
import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from spiked.errors import SceneError
from spiked.export import ExportOptions, ExportSource
from spiked.export.viewer_page import KIND, SCRIPT
from spiked.pose import quaternion
from spiked.scene import Scene
from spiked.scene_changes import SceneChanges, SceneMirror
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory

SENSOR = Sensor(160, 100, 20_000.0, intrinsics=Intrinsics(140.0, 141.0, 80.0, 50.0))


def elements(page: str) -> dict[str, str]:
    return dict(re.findall(r'<script id="(\w+)" type="[^"]+">(.*?)</script>', page, re.DOTALL))


def source(poses: int = 3, **more: object) -> ExportSource:
    rng = np.random.default_rng(0)
    shapes = ((50, 3), (50, 4), (50, 3), (50,), (50, 3))
    scene = Scene(*(rng.normal(size=shape).astype(np.float32) for shape in shapes), white=0.5)
    frames = np.arange(poses) * 10
    path = Trajectory((frames + 0.5) / 20_000, np.eye(3)[None].repeat(poses, 0), rng.normal(size=(poses, 3)))
    return ExportSource(path, SENSOR, scene, name="</script><b>desk & chair", **more)  # type: ignore[arg-type]


@pytest.fixture
def script() -> None:
    if not SCRIPT.is_file():
        pytest.skip("the viewer is not built (make page)")


@pytest.mark.usefixtures("script")
def test_scene_and_path_are_in_the_page(tmp_path: Path) -> None:
    made = source()
    assert "50 splats and 3 poses" in KIND.write(made, tmp_path / "desk.html", ExportOptions())
    page = (tmp_path / "desk.html").read_text()
    about = json.loads(elements(page)["about"])
    assert about["name"] == made.name and "<title>&lt;/script&gt;" in page
    assert about["frames"] == [0, 10, 20]
    np.testing.assert_allclose(about["positions"], made.path.centres)
    np.testing.assert_allclose(about["quaternions_wxyz"], [quaternion(one) for one in made.path.rotations])
    assert about["sensor"]["intrinsics"]["fy"] == 141.0
    mirror = SceneMirror()
    mirror.apply(SceneChanges.read(gzip.decompress(base64.b64decode(elements(page)["scene"]))))
    read, scene = mirror.scene(0.5), made.need_scene()
    np.testing.assert_array_equal(read.means, scene.means)
    np.testing.assert_allclose(read.log_scales, scene.log_scales, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(read.colours, scene.colours, rtol=1e-3, atol=1e-4)


@pytest.mark.usefixtures("script")
def test_only_its_own_script_may_run(tmp_path: Path) -> None:
    KIND.write(source(), tmp_path / "desk.html", ExportOptions())
    page = (tmp_path / "desk.html").read_text()
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(scripts[-1].encode()).digest()).decode()
    assert f"'sha256-{digest}'" in policy and "default-src 'none'" in policy
    assert len(re.findall("<script", page)) == 3 + scripts[-1].count("<script")


@pytest.mark.usefixtures("script")
def test_a_long_path_is_thinned_and_none_is_needed(tmp_path: Path) -> None:
    KIND.write(source(20_000), tmp_path / "long.html", ExportOptions())
    about = json.loads(elements((tmp_path / "long.html").read_text())["about"])
    assert len(about["frames"]) == 5000 and about["frames"][-1] == 199_990
    alone = ExportSource.of_splats(source().need_scene(), "splats")
    KIND.write(alone, tmp_path / "alone.html", ExportOptions())
    about = json.loads(elements((tmp_path / "alone.html").read_text())["about"])
    assert (about["frames"], about["sensor"]) == ([], None)


def test_without_splats_there_is_nothing_to_show(tmp_path: Path) -> None:
    empty = ExportSource(source().path, SENSOR, Scene.empty(1))
    with pytest.raises(SceneError, match="no splats"):
        KIND.write(empty, tmp_path / "none.html", ExportOptions())
    assert not list(tmp_path.iterdir())
