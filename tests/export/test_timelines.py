"""Time lines for Rerun, Foxglove and ROS 2, and HDF5: their readers see the poses, cameras, pictures and points."""

from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from rosbags.highlevel import AnyReader
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.distortion import Distortion
from spiked.errors import ConfigurationError, SceneError
from spiked.export import ExportOptions, ExportSource, find_kind, kind
from spiked.export.timeline import read_timeline, stamps_ns
from spiked.pose import rotation_of
from spiked.recording import ClockPair, open_recording
from spiked.sensor import Sensor

OPTIONS = ExportOptions(views=3, depth="expected", resolution=48)
LENS = Distortion.parse("opencv:-0.1,0.02,0.001,-0.001")
Doubles = NDArray[np.float64]


@pytest.fixture(scope="module")
def bent(source: ExportSource) -> ExportSource:
    """The room as if seen through a lens."""
    assert source.sensor is not None and source.sensor.intrinsics is not None
    return replace(source, sensor=replace(source.sensor, intrinsics=replace(source.sensor.intrinsics, distortion=LENS)))


def our_pixels(source: ExportSource, row: int, points: Doubles) -> tuple[Doubles, NDArray[np.bool_]]:
    """Where the camera of a pose of the path sees world points, [n, 2], and which lie in the picture."""
    sensor = source.sensor
    assert isinstance(sensor, Sensor) and sensor.intrinsics is not None
    local = (points - source.path.centres[row]) @ source.path.rotations[row]
    pixels = sensor.intrinsics.project(local)
    return pixels, (local[:, 2] > 0) & (pixels > 0).all(1) & (pixels < [sensor.width, sensor.height]).all(1)


def opencv_pixels(k: Doubles, d: Doubles, quat_xyzw: Doubles, centre: Doubles, points: Doubles) -> Doubles:
    """The same by OpenCV with a camera of a message, whose first pixel has its centre at 0."""
    rotation = rotation_of(quat_xyzw[[3, 0, 1, 2]][None])[0]
    turn, _ = cv2.Rodrigues(rotation.T)
    seen, _ = cv2.projectPoints(points, turn, -rotation.T @ centre, np.reshape(k, (3, 3)), np.asarray(d))
    return np.asarray(seen.reshape(-1, 2) + 0.5)


def test_rerun_reads_poses_camera_pictures_and_splats(source: ExportSource, bent: ExportSource, tmp_path: Path) -> None:
    file = tmp_path / "room.rrd"
    said = find_kind("rerun").write(source, file, OPTIONS)
    assert "100 poses, 3 pictures" in said
    table = {}
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            table.setdefault(f"{chunk.entity_path} {name}", []).extend(batch.column(name).to_pylist())
    camera = "/world/camera "
    centres = np.array([row[0] for row in table[camera + "Transform3D:translation"]])
    quats = np.array([row[0] for row in table[camera + "Transform3D:quaternion"]])
    assert np.abs(centres - source.path.centres).max() < 1e-5
    k = np.array(table[camera + "Pinhole:image_from_camera"][0][0]).reshape(3, 3).T
    points = np.array(table["/world/points Points3D:positions"][0])
    ours, inside = our_pixels(source, 40, points)
    local = (points - centres[40]) @ rotation_of(quats[40, [3, 0, 1, 2]][None])[0]
    theirs = (local @ k.T)[:, :2] / local[:, 2:]
    assert inside.sum() > 100 and np.abs(theirs - ours)[inside].max() < 0.1
    assert source.scene is not None
    assert np.allclose(table["/world/splats GaussianSplats3D:centers"][0], source.scene.means)
    times = np.array(table[camera + "time"][:100]).astype("timedelta64[ns]").astype(float) / 1e9
    assert np.abs(np.sort(times) - source.path.times_s).max() < 1e-6
    find_kind("rerun").write(bent, file, OPTIONS)  # through a lens: undistorted, and written over


def test_foxglove_schemas_are_read_by_mcap_and_project_to_the_same_pixels(bent: ExportSource, tmp_path: Path) -> None:
    file = tmp_path / "room.mcap"
    find_kind("mcap").write(bent, file, OPTIONS)
    found: dict[str, list] = {}
    with file.open("rb") as stream:
        for schema, channel, message, decoded in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert schema.name.startswith("foxglove.")
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert {topic: len(many) for topic, many in found.items()} == {
        "/tf": 101, "/pose": 100, "/path": 1, "/points": 1, "/camera/calibration": 3, "/camera/picture": 3,
        "/camera/depth": 3,
    }  # fmt: skip
    times = np.array([at for at, _ in found["/pose"]]) / 1e9
    assert np.abs(times - bent.path.times_s).max() < 1e-9
    cloud = found["/points"][0][1]
    points = (
        np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)[:, :12].copy().view("<f4").astype(float)
    )
    pose, calibration = found["/pose"][40][1].pose, found["/camera/calibration"][0][1]
    q, p = pose.orientation, pose.position
    quat, centre = np.array([q.x, q.y, q.z, q.w]), np.array([p.x, p.y, p.z])
    ours, inside = our_pixels(bent, 40, points)
    theirs = opencv_pixels(calibration.K, calibration.D, quat, centre, points)
    assert calibration.distortion_model == "plumb_bob" and np.abs(theirs - ours)[inside].max() < 0.1
    timeline = read_timeline(bent, OPTIONS)
    picture, depth = found["/camera/picture"][1][1], found["/camera/depth"][1][1]
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(pixels, timeline.keys[1].pixels)
    assert np.array_equal(np.frombuffer(depth.data, "<f4").reshape(160, 240), timeline.keys[1].view.depth)


def test_rosbags_reads_the_bag_and_its_camera_projects_to_the_same_pixels(bent: ExportSource, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    for _ in range(2):  # the second one replaces the first
        find_kind("ros-bag").write(bent, folder, OPTIONS)
    assert sorted(file.name for file in folder.iterdir()) == ["bag.db3", "metadata.yaml"]
    found: dict[str, list] = {}
    with AnyReader([folder]) as reader:
        for connection, at, raw in reader.messages():
            found.setdefault(connection.topic, []).append((at, reader.deserialize(raw, connection.msgtype)))
    assert {topic: len(many) for topic, many in found.items()} == {
        "/tf_static": 1, "/points": 1, "/tf": 100, "/pose": 100, "/camera/camera_info": 3, "/camera/image_raw": 3,
        "/camera/depth": 3,
    }  # fmt: skip
    stamp = found["/pose"][40][1].header.stamp
    assert stamp.sec + stamp.nanosec / 1e9 == pytest.approx(bent.path.times_s[40], abs=1e-9)
    cloud = found["/points"][0][1]
    points = cloud.data.reshape(-1, 16)[:, :12].copy().view("<f4").astype(float)
    move, info = found["/tf"][40][1].transforms[0].transform, found["/camera/camera_info"][0][1]
    q, p = move.rotation, move.translation
    ours, inside = our_pixels(bent, 40, points)
    quat, centre = np.array([q.x, q.y, q.z, q.w]), np.array([p.x, p.y, p.z])
    assert np.abs(opencv_pixels(info.k, info.d, quat, centre, points) - ours)[inside].max() < 0.1
    image, timeline = found["/camera/image_raw"][1][1], read_timeline(bent, OPTIONS)
    assert image.encoding == "mono8" and np.array_equal(image.data.reshape(160, 240), timeline.keys[1].pixels)
    up = found["/tf_static"][0][1].transforms[0].transform.rotation
    turned = rotation_of(np.array([[up.w, up.x, up.y, up.z]]))[0]
    assert np.allclose(turned @ [0, -1, 0], [0, 0, 1])  # up of the scene is z of ROS
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(SceneError, match=r"notes\.txt"):
        find_kind("ros-bag").write(bent, folder, OPTIONS)


def test_h5py_reads_spikes_poses_and_depth_and_convert_reads_the_spikes(source: ExportSource, tmp_path: Path) -> None:
    file = tmp_path / "room.nxs"
    find_kind("nexus").write(source, file, OPTIONS)
    assert source.recording is not None and source.scene is not None
    with h5py.File(file) as nexus:
        entry = nexus[nexus.attrs["default"]]
        assert entry.attrs["NX_class"] == "NXentry"
        shown = entry[entry.attrs["default"]]
        assert shown.attrs["NX_class"] == "NXdata" and shown[shown.attrs["signal"]].shape == (3, 160, 240)
        assert np.array_equal(entry["spikes/data"][7], source.recording.images(7, 1)[0])
        assert np.array_equal(entry["path/position"][:], source.path.centres)
        assert np.array_equal(entry["splats/position"][:], source.scene.means)
        assert entry["instrument/optics/fx"].attrs["units"] == "pixel"
        quat, row = entry["path/quaternion"][40], 40
        ours, inside = our_pixels(source, row, entry["points/position"][:].astype(float))
        optics = {name: entry[f"instrument/optics/{name}"][()] for name in ("fx", "fy", "cx", "cy")}
        local = (entry["points/position"][:] - entry["path/position"][row]) @ rotation_of(quat[None])[0]
        theirs = local[:, :2] / local[:, 2:] * [optics["fx"], optics["fy"]] + [optics["cx"], optics["cy"]]
        assert inside.sum() > 100 and np.abs(theirs - ours)[inside].max() < 0.1
    back = tmp_path / "back.dat"
    done = CliRunner().invoke(
        app, ["convert", str(file), str(back), "--array", "entry/instrument/detector/data", "--rate", "20000"]
    )
    assert done.exit_code == 0, done.output
    assert np.array_equal(open_recording(back).images(0, 50), source.recording.images(0, 50))


def test_views_of_chosen_frames_have_their_own_poses(source: ExportSource, tmp_path: Path) -> None:
    options = replace(OPTIONS, frames=(42, 203))
    find_kind("nexus").write(source, tmp_path / "room.nxs", options)
    with h5py.File(tmp_path / "room.nxs") as nexus:
        views = nexus["entry/key_views"]
        for row, pose in enumerate(source.key_poses(options)):
            assert np.allclose(views["position"][row], pose.centre)
            assert np.allclose(rotation_of(views["quaternion"][:])[row], pose.rotation)
            assert not np.array_equal(views["position"][row], source.path.centres[pose.row])


def test_stamps_are_unix_times_where_the_clock_is_known(source: ExportSource) -> None:
    assert source.recording is not None
    rate = source.recording.sensor.frame_rate_hz
    recording = replace(source.recording, clock=(ClockPair(frame=0, unix_ns=10**18),))
    # frame 0 arrived whole at 1 / rate, and its pose is half a frame earlier
    (at,) = stamps_ns(replace(source, recording=recording), np.array([0.5 / rate]))
    assert at == 10**18 - round(0.5e9 / rate)


def test_without_the_recording_pictures_are_rendered_and_it_is_said(source: ExportSource, tmp_path: Path) -> None:
    said = find_kind("nexus").write(replace(source, recording=None), tmp_path / "room.nxs", OPTIONS)
    assert "no frames (the recording is not at hand)" in said and "rendered pictures" in said


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(module: str) -> None:
        raise ImportError(module)

    monkeypatch.setattr(kind, "import_module", gone)
    for name, extra in (("rerun", "rerun"), ("mcap", "mcap"), ("ros-bag", "ros"), ("nexus", "hdf5")):
        with pytest.raises(ConfigurationError, match=rf"spiked\[{extra}\]"):
            find_kind(name).check()
