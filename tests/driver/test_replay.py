"""Recordings played as a camera, and sources named by a line of text."""

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from spiked_driver import Chunk, Faults, FaultySource, Loss, Source, Stall, acquire
from spiked_driver.replay import ReplaySource
from spiked_driver.simulated import SimulatedSource
from spiked_driver.source_kinds import is_camera
from spiked_driver.spec import open_source

from spiked.errors import SourceError, SpikedError
from spiked.recording import RecordingWriter, open_recording
from spiked.ring import DeviceState, End, EndReason, Frames, Gap, LossCause, Policy, RingReader, RingWriter
from spiked.sensor import BitOrder, Intrinsics, Layout, Sensor
from spiked.simulate import MotionKind

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
FRAMES = 50
FRAME_BYTES = 64 * 48 // 8


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """50 frames of random bits at 1 kHz with their sidecar."""
    path = tmp_path_factory.mktemp("replay") / "clip.dat"
    bits().tofile(path)
    sidecar = {
        "format": "compact",
        "width": 64,
        "height": 48,
        "frame_rate": 1000,
        "frames": FRAMES,
        "bit_order": "lsb",
        "flipped": True,
        "cfa": None,
    }
    path.with_suffix(".json").write_text(json.dumps(sidecar))
    return path


def bits() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (FRAMES, FRAME_BYTES), np.uint8)


def play(source: Source, block: int = 8) -> np.ndarray:
    """Everything the source delivers, uint8 [frames, frame_bytes]; checks that the indices run on."""
    source.open()
    chunks: list[np.ndarray] = []
    expected = 0
    view = np.zeros((block, source.sensor.frame_bytes), np.uint8)
    while not isinstance(item := source.read_into(view), End):
        if isinstance(item, Chunk):
            assert item.first == expected
            chunks.append(view[: item.frames].copy())
            expected += item.frames
    assert item == End(expected, EndReason.FINISHED)
    source.close()
    return np.concatenate(chunks)


def test_a_replay_delivers_the_recording(recording: Path) -> None:
    source = ReplaySource(open_recording(recording), pace=0)
    assert source.can_block
    assert source.frames == FRAMES
    np.testing.assert_array_equal(play(source), bits())


def test_ranges_and_repeats_run_on_without_renumbering(recording: Path) -> None:
    source = open_source(f"replay:{recording}?pace=max&range=10:30&repeat=3")
    assert source.frames == 60
    np.testing.assert_array_equal(play(source), np.tile(bits()[10:30], (3, 1)))


def test_a_bare_file_is_described_by_options(tmp_path: Path) -> None:
    path = tmp_path / "bare.dat"
    bits().tofile(path)
    source = open_source(f"replay:{path}?pace=0&width=64&height=48&rate=500")
    assert source.sensor == Sensor(64, 48, 500.0)
    np.testing.assert_array_equal(play(source), bits())


def test_what_the_recording_lost_is_lost_again(tmp_path: Path) -> None:
    path = tmp_path / "lossy.dat"
    with RecordingWriter(path, Sensor(64, 48, 1000.0)) as writer:
        writer.gap(0, 3, "device")
        writer.append(bits()[:20])
        writer.gap(23, 7, "usb")
        writer.append(bits()[20:])
        writer.gap(60, 5, "disk")
    source = open_source(f"replay:{path}?pace=0")
    assert source.frames == 65
    assert items_of(source) == [
        Gap(0, 3, LossCause.DEVICE),
        Chunk(3, 20),
        Gap(23, 7, LossCause.USB),
        Chunk(30, 30),
        Gap(60, 5, LossCause.DISK),
        End(65, EndReason.FINISHED),
    ]
    part = open_source(f"replay:{path}?pace=0&range=10:30&repeat=2")
    assert items_of(part) == [
        Chunk(0, 10),
        Gap(10, 7, LossCause.USB),
        Chunk(17, 10),
        Chunk(27, 10),
        Gap(37, 7, LossCause.USB),
        Chunk(44, 10),
        End(54, EndReason.FINISHED),
    ]


def items_of(source: Source) -> list[Chunk | Gap | End | None]:
    source.open()
    view = np.zeros((100, source.sensor.frame_bytes), np.uint8)
    items = [source.read_into(view)]
    while not isinstance(items[-1], End):
        items.append(source.read_into(view))
    return items


def test_other_bit_orders_and_row_tags_are_delivered_as_compact_lsb_frames(tmp_path: Path) -> None:
    path = tmp_path / "tagged.dat"
    with RecordingWriter(path, Sensor(64, 48, 1000.0, Layout.ROW_TAGGED, BitOrder.MSB)) as writer:
        writer.append(bits())
    source = open_source(f"replay:{path}?pace=0")
    assert (source.sensor.layout, source.sensor.bit_order) == (Layout.COMPACT, BitOrder.LSB)
    np.testing.assert_array_equal(play(source), bits())


def test_a_source_can_be_opened_again(recording: Path) -> None:
    source = open_source(f"replay:{recording}?pace=0&range=:20")
    np.testing.assert_array_equal(play(source), play(source))
    assert source.device_status.state is DeviceState.IDLE


def test_a_paced_replay_does_not_wait_for_readers(recording: Path) -> None:
    source = open_source(f"replay:{recording}?pace=20")
    assert not source.can_block
    np.testing.assert_array_equal(play(source), bits())


def test_faults_are_options_of_every_source(recording: Path) -> None:
    line = "pace=0&drop=0.1&drop_run=2&fault_seed=4&gap=5:3&gap=10:2:disk&unplug-at=20:5&stall=30:0.5&corrupt=0.2"
    losses = (Loss(5, 3), Loss(10, 2, LossCause.DISK), Loss(20, 5, LossCause.DEVICE, unplugged=True))
    expected = Faults(losses, (Stall(30, 0.5),), drop=0.1, drop_run=2, seed=4, corrupt=0.2)
    for spec, kind in ((f"replay:{recording}?{line}", ReplaySource), (f"sim:?{line}", SimulatedSource)):
        source = open_source(spec)
        assert isinstance(source, FaultySource)
        assert isinstance(source.inner, kind)
        assert source.faults == expected


def test_lengths_of_faults_may_be_times() -> None:
    source = open_source("sim:?rate=20000&gap=5:1.5ms:ring&unplug-at=100:2s&stall=30:40ms&stall=40:1s")
    assert isinstance(source, FaultySource)
    losses = (Loss(5, 30, LossCause.RING), Loss(100, 40_000, LossCause.DEVICE, unplugged=True))
    assert source.faults == Faults(losses, (Stall(30, 0.04), Stall(40, 1.0)))


def test_corrupted_frames_are_the_same_however_they_are_read(recording: Path) -> None:
    options = "pace=0&corrupt=0.3&fault_seed=2&gap=7:9"
    spoilt = [read_all(open_source(f"replay:{recording}?{options}"), block) for block in (1, 7, 50)]
    np.testing.assert_array_equal(spoilt[0], spoilt[1])
    np.testing.assert_array_equal(spoilt[0], spoilt[2])
    kept = np.delete(bits(), slice(7, 16), axis=0)
    wrong = (spoilt[0] != kept).any(axis=1)
    assert 3 < wrong.sum() < 25
    assert (spoilt[0] == kept)[~wrong].all()


def read_all(source: Source, block: int) -> NDArray[np.uint8]:
    """All frames, uint8 [n, frame_bytes], read in blocks."""
    source.open()
    view = np.zeros((block, source.sensor.frame_bytes), np.uint8)
    frames = []
    while not isinstance(item := source.read_into(view), End):
        if isinstance(item, Chunk):
            frames.append(view[: item.frames].copy())
    return np.concatenate(frames)


def test_a_simulation_is_described_by_its_options() -> None:
    source = open_source("sim:?seed=4&seconds=0.01&width=64&height=48&rate=10000&pace=0&motion=arc")
    assert (source.sensor.width, source.sensor.height, source.sensor.frame_rate_hz) == (64, 48, 10_000)
    assert source.sensor.intrinsics is not None
    assert source.frames == 100


def test_cameras_are_described_without_being_there() -> None:
    usb, card = open_source("usb:2-1.4?fov=40&rate=10000"), open_source("pcie:/dev/JR6101?fov=50")
    assert (usb.sensor.width, usb.sensor.height, usb.sensor.frame_rate_hz) == (400, 250, 10_000)
    assert usb.sensor.intrinsics == Intrinsics.from_fov(400, 250, 40)
    assert (card.sensor.width, card.sensor.height, card.sensor.frame_rate_hz) == (1000, 1000, 20_000)
    assert card.sensor.intrinsics == Intrinsics.from_fov(1000, 1000, 50)
    assert open_source("usb0").sensor.intrinsics is None
    assert not open_source("usb0").can_block


@pytest.mark.parametrize(
    ("spec", "camera"),
    [("usb0", True), ("usb0?fov=4", True), ("usb:7", True), ("pcie:/dev/JR6101", True), ("sim:", False)],
)
def test_cameras_are_told_from_files_and_simulations(spec: str, camera: bool) -> None:
    assert is_camera(spec) is camera


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("camera", "names no kind"),
        ("parallel:", "no kind 'parallel'"),
        ("usb9:", "names no USB camera"),
        ("usb:", "names no USB camera"),
        ("usb0?pace=1", "no option pace.*rate.*hide_ms"),
        ("usb0?fov=500", "fov=500"),
        ("pcie:", "names no path"),
        ("pcie:/dev/JR6101?rate=0", "rate=0"),
        ("sim:room.ply", "options only"),
        ("sim:?sead=1", "no option sead.*seed"),
        ("sim:?width=wide", "width=wide"),
        ("sim:?seed=1&seed=2", "seed"),
        ("sim:?drop=1", "drop=1"),
        ("sim:?gap=5", "gap=5"),
        ("sim:?gap=5:1.5", "neither a number of frames nor a time"),
        ("sim:?unplug-at=5:2:disk", "unplug_at"),
        ("sim:?corrupt=2", "corrupt=2"),
        ("sim:?gap=5:3&gap=6:1", "overlap"),
        ("sim:?gap=5:0", "at least one frame"),
        ("sim:?pace=-1", "pace=-1"),
        ("sim:?threads=100000", "threads=100000: it must be less than or equal to 64"),
        ("sim:?rate=inf", "rate=inf: it must be a finite number"),
        ("sim:?rate=nan", "rate=nan"),
        ("sim:?rate=1e30", "rate=1e30"),
        ("sim:?seed=-1", "seed=-1: it must be greater than or equal to 0"),
        ("sim:?seed=99999999999999999999", "seed=9"),
        ("sim:?width=16384&height=16384", "frames of 16384x16384 are larger than"),
        ("sim:?width=100000", "width=100000"),
        ("sim:?seconds=inf", "seconds=inf"),
        ("sim:?flow_px=nan", "flow_px=nan"),
        ("sim:?pace=1e300", "pace=1e300"),
        ("sim:?drop=nan", "drop=nan"),
        ("sim:?drop_run=10000000000", "drop_run"),
        ("sim:?stall=5:nans", "stall=5:nans"),
        ("sim:?stall=5:1e9s", "stall=5:1e9s"),
        ("sim:?gap=-5:3", "gap=-5:3"),
        ("sim:?gap=5:99999999999999999999", "neither a number of frames nor a time"),
        ("sim:?fault-seed=-1", "fault_seed=-1"),
        ("replay:{}?width=16384&height=16384", "larger than"),
        ("replay:{}?repeat=99999999999", "repeat"),
        ("usb0?rate=inf", "rate=inf"),
        ("usb0?silence_s=inf", "silence_s=inf"),
        ("usb0?hide_ms=nan", "hide_ms=nan"),
        ("pcie:/dev/JR6101?rate=1e30", "rate=1e30"),
        ("replay:{}?range=40:60", "range 40:60"),
        ("replay:{}?range=7", "range=7"),
        ("replay:{}?repeat=0", "repeat=0"),
        ("replay:{}.missing", "missing"),
    ],
)
def test_a_wrong_line_is_refused_in_one_line_that_says_what(recording: Path, spec: str, message: str) -> None:
    with pytest.raises(SpikedError, match=message) as caught:
        open_source(spec.format(recording))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("motion", MotionKind)
@pytest.mark.parametrize(
    "options", [f"width=8&height=1&rate=0.1&flow_px=8&seed={2**32 - 1}", "width=64&height=48&rate=1e6&flow_px=1e-4"]
)
def test_what_the_bounds_allow_can_be_simulated(options: str, motion: MotionKind) -> None:
    source = open_source(f"sim:?pace=0&motion={motion}&{options}")
    source.open()
    assert source.read_into(np.zeros((4, source.sensor.frame_bytes), np.uint8)) == Chunk(0, 4)


def test_a_real_stream_goes_through_the_ring_unchanged() -> None:
    path = SHARED / "streams/living/living.dat"
    if not path.exists():
        pytest.skip(f"{path} is not on this machine")
    expected = np.fromfile(path, np.uint8).reshape(-1, 12_500)
    source = open_source(f"replay:{path}?pace=0&range=100:500")
    with RingWriter.create(source.sensor, slots=16) as writer:
        reader = RingReader.attach(writer.name, Policy.LOSSLESS, "test")
        assert reader.geometry.sensor.intrinsics is not None
        thread = threading.Thread(target=acquire, args=(source, writer, threading.Event()))
        thread.start()
        received = []
        while not isinstance(item := reader.next(10.0), End):
            assert isinstance(item, Frames)
            received.append(item.data.copy())
            assert item.release()
        thread.join()
    np.testing.assert_array_equal(np.concatenate(received), expected[100:500])


@st.composite
def faults(draw: st.DrawFn) -> Faults:
    starts = sorted(draw(st.sets(st.integers(0, FRAMES + 5), max_size=4)))
    ends = [*starts[1:], FRAMES + 10]
    causes = st.sampled_from([LossCause.USB, LossCause.DEVICE, LossCause.DISK])
    losses = [Loss(a, draw(st.integers(1, b - a)), draw(causes)) for a, b in zip(starts, ends, strict=False)]
    stalls = [Stall(frame, 0.0) for frame in draw(st.sets(st.integers(0, FRAMES), max_size=2))]
    drop = draw(st.sampled_from([0.0, 0.05, 0.5, 0.95]))
    return Faults(tuple(losses), tuple(stalls), drop, draw(st.integers(1, 5)), draw(st.integers(0, 99)))


@settings(deadline=None)
@given(inner=faults(), outer=faults(), block=st.integers(1, 9))
def test_whatever_the_faults_each_frame_comes_once_or_is_lost_once(
    recording: Path, inner: Faults, outer: Faults, block: int
) -> None:
    source = FaultySource(FaultySource(ReplaySource(open_recording(recording), pace=0), inner), outer)
    source.open()
    view = np.zeros((block, source.sensor.frame_bytes), np.uint8)
    expected = 0
    lost = np.zeros(FRAMES, bool)
    while not isinstance(item := source.read_into(view), End):
        if item is None:
            continue
        assert item.first == expected
        if isinstance(item, Chunk):
            np.testing.assert_array_equal(view[: item.frames], bits()[item.first : item.first + item.frames])
            expected += item.frames
        else:
            expected += item.count
            lost[item.first : item.first + item.count] = True
    assert item == End(FRAMES, EndReason.FINISHED)
    assert expected == FRAMES
    for loss in inner.losses + outer.losses:
        assert lost[loss.first : loss.first + loss.count].all()


def test_a_range_outside_the_recording_is_refused(recording: Path) -> None:
    with pytest.raises(SourceError, match="50 frames"):
        ReplaySource(open_recording(recording), first=10, stop=10)
