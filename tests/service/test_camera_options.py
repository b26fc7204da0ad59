"""What options, requests and profiles state of a camera reaches recording, preview and reconstruction."""

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from spiked_service.captures.archive import DataStore
from spiked_service.captures.sources import with_options
from spiked_service.results.versions import versions
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import CaptureState, JobState, Plan
from spiked_service.workers.messages import PreviewKind, ReconstructionCommand
from spiked_service.workers.roles.reconstruction import options_of
from waiting import until

from spiked.calibration import Calibration
from spiked.camera import CameraFiles, CameraOptions, Pinhole
from spiked.errors import CalibrationError, ConfigurationError, ProfileError
from spiked.profile import CameraProfile
from spiked.recording import RecordingWriter, open_recording, read_sidecar, recorded_calibration, sidecar_path
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import SimulatedCamera

from .survival import children, jobs_of, kept, over, random_recording

SIZE = "width=96&height=64"


@pytest.fixture
def data_store(tmp_path: Path) -> Iterator[DataStore]:
    with kept(tmp_path / "data") as one:
        yield one
    until(lambda: children() == [], "every worker has left")


def recorded(data_store: DataStore, source: str, **more: object) -> tuple[Path, Plan]:
    """The recording of a capture of 400 frames that is over."""
    plan = Plan(source, frames=400, reconstruct=False, **more)  # type: ignore[arg-type]
    done = over(data_store, data_store.captures.start(plan).id).row
    assert (done.state, done.reason) == (CaptureState.COMPLETE, "")
    return data_store.captures.recording(done.id), done.plan


def write_calibration(path: Path, dead: int = 3) -> Calibration:
    """Of a 96x64 sensor, with some dead pixels."""
    gain, marks = np.full((64, 96), 1.25, np.float32), np.zeros((64, 96), bool)
    marks[0, :dead] = True
    found = Calibration(gain, np.full((64, 96), 0.01, np.float32), marks)
    found.write(path)
    return found


def test_a_mosaic_passes_from_the_source_to_recording_and_preview(data_store: DataStore) -> None:
    source = f"sim:?{SIZE}&mosaic=BGGR&flipped=false&fov=50&seed=5&pace=0"
    started = data_store.captures.start(Plan(source, frames=400, reconstruct=False))
    done = over(data_store, started.id).row
    assert (done.state, done.reason) == (CaptureState.COMPLETE, "")
    optics = Intrinsics.from_fov(96, 64, 50)
    assert done.sensor == Sensor(96, 64, 20_000.0, flipped=False, mosaic=Mosaic.BGGR, intrinsics=optics)
    recording = open_recording(data_store.captures.recording(done.id))
    assert recording.sensor == done.sensor
    expected = SimulatedCamera(done.sensor, seed=5).next_frames(400)
    np.testing.assert_array_equal(recording.read(0, 400), expected)
    picture = data_store.captures.picture(done.id)
    assert picture is not None
    for kind in PreviewKind:
        shown = cv2.imdecode(np.frombuffer(base64.b64decode(picture.images[kind]), np.uint8), cv2.IMREAD_UNCHANGED)
        assert shown.shape == (64, 96, 3)
        assert np.ptp(shown.astype(int), axis=2).max() > 30, "the room is not grey"


def test_a_colour_camera_is_mapped_in_colour_live(data_store: DataStore) -> None:
    source = "sim:?width=160&height=96&mosaic=GRBG&motion=arc&flow_px=0.25&seed=2"
    options = ReconstructionOptions(steps=30)
    started = data_store.captures.start(Plan(f"{source}&pace=0", frames=480, record=False, options=options))
    done = over(data_store, started.id)
    (job,) = jobs_of(data_store, done.id)
    assert (job.state, job.live) == (JobState.COMPLETE, True), job.reason
    folder = data_store.folder.reconstruction(job.id)
    scene = Scene.read_ply(folder / versions(folder)[-1].scene)
    assert scene.colours.shape[1] == 3
    assert np.ptp(scene.colours, axis=1).mean() > 0.1 * scene.colours.mean(), "the room has colours"


def test_a_mosaic_that_is_not_stated_is_a_warning_of_the_capture(data_store: DataStore, tmp_path: Path) -> None:
    sensor = Sensor(160, 96, 20_000.0, mosaic=Mosaic.GRBG)
    frames = SimulatedCamera(sensor, seed=2).next_frames(400)
    for stated in (None, Mosaic.GRBG):
        path = tmp_path / f"{stated}.dat"
        with RecordingWriter(path, replace(sensor, mosaic=stated)) as writer:
            writer.append(frames)
        started = data_store.captures.start(Plan(f"replay:{path}?pace=0.1", reconstruct=False))
        warnings = over(data_store, started.id).row.warnings
        told = [warning for warning in warnings if "colour mosaic" in warning]
        assert len(told) == (stated is None), warnings
        assert not told or "GRBG or GBRG" in told[0]


def test_options_of_a_request_win_over_those_of_the_source() -> None:
    camera = CameraOptions(mosaic=Mosaic.RGGB, flipped=True, intrinsics=Pinhole(fx=9.0, fy=9.5, cx=4.0, cy=3.0))
    text = with_options("pcie:/dev/JR6101?mosaic=BGGR&fov=50&rate=40000&flip=false", camera)
    assert text == "pcie:/dev/JR6101?rate=40000&mosaic=RGGB&flipped=true&intrinsics=9.0,9.5,4.0,3.0"
    assert with_options("sim:", CameraFiles()) == "sim:"


def test_a_profile_completes_a_source_and_is_kept_in_the_sidecar(data_store: DataStore, tmp_path: Path) -> None:
    profiles = data_store.folder.profiles
    found = write_calibration(profiles / "camera.npz")
    profile = CameraProfile(model="toy", mosaic=Mosaic.GBRG, flipped=False, fov=70, calibration=Path("camera.npz"))
    profile.write(profiles / "sim%3A.json")
    path, _ = recorded(data_store, f"sim:?{SIZE}&fov=50&pace=0")
    sensor = open_recording(path).sensor
    assert (sensor.mosaic, sensor.flipped) == (Mosaic.GBRG, False)
    assert sensor.intrinsics == Intrinsics.from_fov(96, 64, 50)
    sidecar = read_sidecar(sidecar_path(path))
    assert sidecar.profile == json.loads((profiles / "sim%3A.json").read_text())
    beside = recorded_calibration(path)
    assert beside == path.with_name("calibration.npz")
    np.testing.assert_array_equal(Calibration.read(beside).dead, found.dead)


def test_a_profile_named_by_the_source_wins_over_the_stored_one(data_store: DataStore, tmp_path: Path) -> None:
    CameraProfile(mosaic=Mosaic.GBRG).write(data_store.folder.profiles / "sim%3A.json")
    CameraProfile(mosaic=Mosaic.RGGB).write(tmp_path / "other.json")
    path, _ = recorded(data_store, f"sim:?{SIZE}&pace=0&profile={tmp_path / 'other.json'}")
    assert open_recording(path).sensor.mosaic is Mosaic.RGGB


def test_what_does_not_fit_the_camera_is_told_before_the_capture(data_store: DataStore, tmp_path: Path) -> None:
    write_calibration(tmp_path / "camera.npz")
    CameraProfile(width=1000, height=1000).write(tmp_path / "camera.json")
    for option, error, told in (
        (f"width=64&calibration={tmp_path / 'camera.npz'}", CalibrationError, "of 96x64 pixels"),
        (f"calibration={tmp_path / 'missing.npz'}", CalibrationError, "cannot read the calibration"),
        (f"profile={tmp_path / 'missing.json'}", ProfileError, "cannot be read"),
    ):
        with pytest.raises(error, match=told):
            data_store.captures.start(Plan(f"sim:?{option}", frames=10))
    random_recording(tmp_path / "noise.dat", 100)
    with pytest.raises(ProfileError, match="1000x1000 pixels and the camera of 96x64"):
        data_store.captures.start(Plan(f"replay:{tmp_path / 'noise.dat'}?profile={tmp_path / 'camera.json'}"))


def test_a_replay_takes_the_calibration_of_its_recording(data_store: DataStore, tmp_path: Path) -> None:
    write_calibration(tmp_path / "camera.npz")
    path, _ = recorded(data_store, f"sim:?{SIZE}&pace=0&calibration={tmp_path / 'camera.npz'}")
    again, _ = recorded(data_store, f"replay:{path}?mosaic=RGGB")
    assert recorded_calibration(again) is not None
    assert open_recording(again).sensor.mosaic is Mosaic.RGGB


@pytest.mark.parametrize("live", [True, False])
def test_a_reconstruction_reads_the_calibration(data_store: DataStore, tmp_path: Path, live: bool) -> None:
    found = write_calibration(tmp_path / "camera.npz", dead=7)
    path, plan = recorded(data_store, f"sim:?{SIZE}&pace=0&calibration={tmp_path / 'camera.npz'}")
    command = ReconstructionCommand(
        ring="a ring" if live else None,
        recording=None if live else path,
        folder=tmp_path,
        can_block=True,
        options=plan.options,
        intrinsics=None,
        calibration=tmp_path / "camera.npz" if live else None,
    )
    measured = options_of(command, None if live else open_recording(path)).calibration
    assert measured is not None
    np.testing.assert_array_equal(measured.dead, found.dead)


def test_an_armed_device_keeps_its_options(data_store: DataStore) -> None:
    data_store.captures.arm(f"sim:?{SIZE}&mosaic=BGGR", 0.1)
    source = f"sim:?{SIZE}&mosaic=BGGR"
    armed = data_store.captures.armed()[source]
    until(lambda: armed.counters() is not None, "it is armed")
    CameraProfile(flipped=False).write(data_store.folder.profiles / "sim%3A.json")
    with pytest.raises(ConfigurationError, match="disarm it"):
        data_store.captures.start(Plan(source, frames=10, reconstruct=False))
