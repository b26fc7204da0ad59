"""`Spiked` on the scene of a real service: cleaned and brought back, its scale and up."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from published_map import published_map
from spiked_service.results.versions import RecordedPath
from spiked_service.store.rows import Plan
from tag_card import BOARD, SQUARE_M, board_card, card_scene

from spiked.client import ApiError, OutlineModel, Spiked
from spiked.recording import RecordingWriter
from spiked.scene import Scene
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory

from ..service.survival import kept, over

SENSOR = Sensor(400, 248, 20_000.0)
DISTANCE = 0.12
"""Of the two cameras of the map, whose unit is a metre."""
CARD, PATH, CAMERA = card_scene(board_card())


@pytest.fixture(scope="module")
def client(daemon_class: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Spiked]:
    folder = tmp_path_factory.mktemp("edited")
    with RecordingWriter(folder / "dark.dat", SENSOR) as writer:
        writer.append(np.zeros((256, SENSOR.frame_bytes), np.uint8))
    beside = Trajectory(PATH.times_s, PATH.rotations, PATH.centres + PATH.rotations @ [DISTANCE, 0, 0])
    with kept(folder / "data") as store:
        capture_id = over(store, store.captures.start(Plan(f"replay:{folder / 'dark.dat'}", reconstruct=False)).id).id
        others = [RecordedPath(capture_id, SENSOR.frame_rate_hz, beside)]
        published_map(store, capture_id, CARD, PATH, CAMERA.intrinsics, others=others)
    daemon = daemon_class("--no-capture", folder=folder)
    with Spiked(daemon.address, timeout_s=240) as one:
        yield one
    daemon.close()


@pytest.fixture
def job(client: Spiked) -> str:
    (only,) = client.reconstructions()
    client.forget_scale(only.id)
    return only.id


def splats(client: Spiked, job: str, folder: Path) -> int:
    (folder / "scene.ply").write_bytes(client.scene(job))
    return len(Scene.read_ply(folder / "scene.ply"))


def test_a_scene_is_cleaned_and_brought_back(client: Spiked, job: str, tmp_path: Path) -> None:
    before = client.reconstruction(job)
    low, high = np.percentile(CARD.means, (5, 95), axis=0)
    cut = client.clean(job, floaters=False, box=(low.tolist(), high.tolist()))
    assert cut.version == before.version + 1 and cut.outside > 0
    assert splats(client, job, tmp_path) == cut.splats == len(CARD) - cut.outside
    with pytest.raises(ApiError, match="is the newest now, not 1") as refused:
        client.clean(job, floaters=False, version=before.version)
    assert refused.value.status == 409
    camera = {"position": PATH.centres[0].tolist(), "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    outline = OutlineModel.model_validate({"corners": [[-9, -9], [9, -9], [9, 9], [-9, 9]], "camera": camera})
    outlined = client.clean(job, floaters=False, outline=outline)
    assert outlined.outlined > 0 and outlined.splats == cut.splats - outlined.outlined
    assert client.revert(job, before.version).splats == len(CARD)


def test_a_scale_replaces_the_one_that_is_known_or_named(client: Spiked, job: str) -> None:
    stored = client.set_scale(job, metres_per_unit=2.0, sigma=0.01)
    assert (stored.metres_per_unit, stored.sigma, stored.source) == (2.0, 0.01, "length")
    assert client.set_scale(job, up=np.array([0.0, 0.0, 2.0])).up == [0.0, 0.0, 1.0]
    assert client.scale(job).metres_per_unit == 2.0
    with pytest.raises(ApiError, match="read it and change that one"):
        client.set_scale(job, metres_per_unit=3.0, revision=stored.revision)
    assert client.forget_scale(job).metres_per_unit is None


def test_a_board_a_rig_and_the_floor_are_found(client: Spiked, job: str) -> None:
    board = client.scale_by_board(job, f"{BOARD.columns}x{BOARD.rows}", SQUARE_M)
    assert board.scale.metres_per_unit == pytest.approx(1.0, abs=3e-3) and board.views >= 40
    rig = client.scale_by_baseline(job, 0.24, offset_s=0.0)
    assert rig.scale.metres_per_unit == pytest.approx(2.0, rel=1e-5) and rig.scale.source == "baseline"
    floor = client.find_up(job)
    assert floor.up is not None and np.degrees(np.arccos(floor.up[2])) < 2
    tilted = client.find_up(job, gravity=(0, 9.81, 0), frame=0)
    np.testing.assert_allclose(tilted.up, -PATH.rotations[0][:, 1], atol=1e-6)
    points = client.find_up(job, points=[(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    np.testing.assert_allclose(points.up, [0, 0, 1], atol=1e-9)
    with pytest.raises(ApiError, match="no tag is in any picture"):
        client.scale_by_tag(job, 0.1)
    assert client.scale(job).source == "baseline"
