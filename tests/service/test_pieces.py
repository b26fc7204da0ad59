"""The service's small parts: ids, pictures, versions, sources, feeding around gaps."""

import uuid
from pathlib import Path

import cv2
import numpy as np
import pytest
from spiked_service.captures import hurried, unhurried
from spiked_service.ids import new_id
from spiked_service.images import ImageFormat, encode
from spiked_service.offline import Piece, pieces
from spiked_service.publication import Publisher, at, newest, versions

from spiked.recording import RecordingWriter, open_recording
from spiked.scene import Scene
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory


def test_ids_are_uuids_of_version_7_and_sort_by_time() -> None:
    ids = [new_id() for _ in range(50)]
    assert {uuid.UUID(one).version for one in ids} == {7}
    assert {uuid.UUID(one).variant for one in ids} == {uuid.RFC_4122}
    milliseconds = [uuid.UUID(one).int >> 80 for one in ids]
    assert milliseconds == sorted(milliseconds)
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize("channels", [1, 3])
def test_png_divides_by_white_and_clips(channels: int) -> None:
    radiance = np.linspace(0, 0.6, 30 * 40 * channels, dtype=np.float32).reshape(30, 40, channels)
    png = np.frombuffer(encode(radiance, ImageFormat.PNG, white=0.5), np.uint8)
    decoded = cv2.imdecode(png, cv2.IMREAD_UNCHANGED).reshape(30, 40, channels)[..., ::-1]
    np.testing.assert_allclose(decoded, np.clip(radiance / 0.5, 0, 1) * 255, atol=0.51)


def test_exr_keeps_radiance_exactly(tmp_path: Path) -> None:
    oiio = pytest.importorskip("OpenImageIO")
    radiance = np.random.default_rng(0).random((20, 30, 1), np.float32) * 3
    path = tmp_path / "view.exr"
    path.write_bytes(encode(radiance, ImageFormat.EXR, white=1.0))
    np.testing.assert_array_equal(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT), radiance)


def test_a_reader_of_an_older_index_still_finds_its_files(tmp_path: Path) -> None:
    publisher = Publisher(tmp_path)
    assert newest(tmp_path) is None
    trajectory = Trajectory(np.array([0.5]), np.eye(3)[None], np.zeros((1, 3)))
    seen = []
    for number in range(1, 61):
        published = publisher.publish(Scene.empty(1), trajectory, white=0.1 * number)
        assert newest(tmp_path) == published
        seen.append(published)
        assert all((tmp_path / old.scene).exists() and (tmp_path / old.trajectory).exists() for old in seen[-3:])
    kept = versions(tmp_path)
    assert [one.version for one in kept] == publisher.kept
    assert len(kept) <= 35 and kept[0].version == 1 and kept[-1].version == 60
    assert at(tmp_path, kept[5].version) == kept[5]
    assert at(tmp_path, 2) is None
    files = {path.name for path in tmp_path.iterdir()}
    assert files == {name for one in kept for name in (one.scene, one.trajectory)} | {"published.json"}
    assert Publisher(tmp_path).publish(Scene.empty(1), trajectory, 0.1).version == 61


@pytest.mark.parametrize(
    ("given", "used"),
    [
        ("sim:", "sim:?pace=0"),
        ("replay:a.dat?repeat=2", "replay:a.dat?repeat=2&pace=0"),
        ("replay:a.dat?pace=1", "replay:a.dat?pace=1"),
        ("usb0", "usb0"),
    ],
)
def test_a_source_that_can_wait_waits_unless_a_pace_is_given(given: str, used: str) -> None:
    assert unhurried(given) == used


def test_feeding_follows_the_capture_index_around_gaps(tmp_path: Path) -> None:
    sensor = Sensor(8, 4, 1000.0)
    with RecordingWriter(tmp_path / "rec.dat", sensor) as writer:
        writer.append(np.zeros((100, sensor.frame_bytes), np.uint8))
        writer.gap(30, 5, "usb")
        writer.gap(70, 1, "device")
    recording = open_recording(tmp_path / "rec.dat")
    assert list(pieces(recording, chunk=32)) == [
        Piece(0, 30, 0),
        Piece(30, 32, 35),
        Piece(62, 3, 67),
        Piece(65, 32, 71),
        Piece(97, 3, 103),
    ]


@pytest.mark.parametrize(
    ("given", "used"),
    [("sim:?pace=0", "sim:"), ("sim:?seed=1&pace=0", "sim:?seed=1"), ("usb0?fov=40", "usb0?fov=40"), ("usb0", "usb0")],
)
def test_an_armed_source_runs_at_its_own_pace(given: str, used: str) -> None:
    assert hurried(given) == used
