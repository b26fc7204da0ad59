"""A 1000x1000 colour camera through a capture card: raw stream, daemon, recording, preview, map and its views."""

import base64
import json
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from spiked_service.captures.archive import DataStore
from spiked_service.store.rows import CaptureState, Plan
from spiked_service.workers.messages import PreviewKind
from waiting import until

from spiked.recording import open_recording
from spiked.ring import DeviceState
from spiked.sensor import Mosaic, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from tests.virtual_card import virtual_card

from .survival import children, kept, over

SENSOR = Sensor(1000, 1000, 20_000.0, flipped=False, mosaic=Mosaic.GRBG)
FRAMES = 104
STREAMS = Path(__file__).parents[2].parent / "shared" / "streams"


@pytest.fixture
def data_store(tmp_path: Path) -> Iterator[DataStore]:
    with kept(tmp_path / "data") as one:
        yield one
    until(lambda: children() == [], "every worker has left")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compact frames of the room in colour."""
    path = tmp_path_factory.mktemp("card") / "frames.dat"
    camera = SimulatedCamera(SENSOR, seed=2, motion=MotionKind.ARC, flow_px=0.1, threads=2)
    camera.next_frames(FRAMES).tofile(path)
    return path


def colourfulness(encoded: bytes) -> float:
    """Mean difference of the strongest and weakest colour, of 255."""
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.shape == (1000, 1000, 3)
    return float(np.ptp(image.astype(int), axis=2).mean())


def test_a_damaged_stream_is_recorded_bit_by_bit_and_seen_in_colour(
    data_store: DataStore, scene: Path, tmp_path: Path
) -> None:
    pipe = tmp_path / "card"
    os.mkfifo(pipe)
    plan = Plan(f"pcie:{pipe}?mosaic=GRBG&flipped=false&fov=60", reconstruct=False)
    started = data_store.captures.start(plan)
    with virtual_card(scene, pipe, rate=60, damage="flip:50,cut:70,junk:90"):
        row = over(data_store, started.id).row
    assert (row.state, row.reason) == (CaptureState.COMPLETE, "")
    assert row.recording is not None and row.recording.lost_by_cause == {"usb": 4}
    recording = open_recording(data_store.captures.recording(row.id))
    assert (recording.assumed, row.warnings) == ((), ())
    sensor = recording.sensor
    assert (sensor.mosaic, sensor.flipped, sensor.width) == (Mosaic.GRBG, False, 1000)
    sent = np.fromfile(scene, np.uint8).reshape(FRAMES, -1)
    # Where half a frame is missing, the next one has no end of a frame before it, so that its start is not recognised.
    kept_frames = [frame for frame in range(FRAMES) if frame not in (50, 70, 71, 90)]
    np.testing.assert_array_equal(recording.read(0, recording.frames), sent[kept_frames])
    assert [(gap.first, gap.count) for gap in recording.gaps] == [(50, 1), (70, 2), (90, 1)]
    picture = data_store.captures.picture(row.id)
    assert picture is not None
    for kind in PreviewKind:
        assert colourfulness(base64.b64decode(picture.images[kind])) > 15


def test_a_capture_waits_for_an_absent_card(data_store: DataStore, scene: Path, tmp_path: Path) -> None:
    pipe = tmp_path / "card"
    started = data_store.captures.start(Plan(f"pcie:{pipe}?mosaic=GRBG", reconstruct=False))
    until(lambda: data_store.captures.get(started.id).row.state is CaptureState.WAITING, "the card is missed")
    counters = data_store.captures.get(started.id).counters
    assert counters is not None and counters.device is DeviceState.ABSENT
    assert "check the path, the capture card" in counters.device_reason
    os.mkfifo(pipe)
    with virtual_card(scene, pipe, rate=200):
        row = over(data_store, started.id).row
    assert (row.state, row.reason) == (CaptureState.COMPLETE, "")
    recording = open_recording(data_store.captures.recording(row.id))
    np.testing.assert_array_equal(recording.read(0, recording.frames), np.fromfile(scene, np.uint8).reshape(FRAMES, -1))


@pytest.mark.skipif(not STREAMS.exists(), reason="../shared/streams is absent")
@pytest.mark.parametrize("name", ["camp_color"])
def test_a_stream_live_is_the_recording_of_its_file(data_store: DataStore, tmp_path: Path, name: str) -> None:
    """The same bytes and the same sensor, so that every reconstruction of it is that of the file."""
    stream = STREAMS / name / f"{name}.dat"
    optics = ",".join(
        f"{value!r}" for value in json.loads(stream.with_suffix(".json").read_text())["intrinsics"].values()
    )
    pipe = tmp_path / "card"
    os.mkfifo(pipe)
    started = data_store.captures.start(Plan(f"pcie:{pipe}?mosaic=BGGR&intrinsics={optics}", reconstruct=False))
    with virtual_card(stream, pipe, rate=100):
        row = over(data_store, started.id).row
    recorded = data_store.captures.recording(row.id)
    assert [text.partition(",")[0] for text in row.warnings] == ["nothing says which way up its rows come"]
    assert open_recording(recorded).questions == row.warnings
    assert recorded.read_bytes() == stream.read_bytes()
    assert open_recording(recorded).sensor == open_recording(stream).sensor
