"""Recordings are read as the bytes say, described as their sidecars say, and written so that they survive."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from spiked.errors import RecordingError
from spiked.recording import (
    Durability,
    Gap,
    OriginKind,
    Recording,
    RecordingWriter,
    open_recording,
    sidecar_path,
    verify,
)
from spiked.recording.time_base import measured_rate
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Sensor

SHARED = Path(__file__).parents[2] / "shared"
with_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="the recordings in ../shared are not here")

SENSORS = {
    "A": Sensor(400, 250, 20_000.0, intrinsics=Intrinsics(346.5, 346.5, 200.0, 125.0)),
    "B": Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED),
    "D": Sensor(1000, 1000, 20_000.0, mosaic=Mosaic.BGGR),
    "F": Sensor(600, 400, 40_000.0, flipped=False),
    "F, MSB first": Sensor(320, 180, 40_000.0, bit_order=BitOrder.MSB),
    "odd": Sensor(8, 3, 1_000.0, Layout.ROW_TAGGED, BitOrder.MSB, flipped=False),
}


def random_frames(sensor: Sensor, count: int) -> NDArray[np.uint8]:
    """Compact frames, uint8 [count, height * row_bytes]."""
    return np.random.default_rng(count).integers(0, 256, (count, sensor.compact().frame_bytes), np.uint8)


def written(path: Path, sensor: Sensor, count: int = 5) -> Recording:
    with RecordingWriter(path, sensor) as writer:
        writer.append(random_frames(sensor, count))
    return open_recording(path)


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS.keys())
def test_every_flavour_comes_back_as_it_was_written(tmp_path: Path, sensor: Sensor) -> None:
    recording = written(tmp_path / "a.dat", sensor)
    assert (recording.sensor, recording.frames, recording.warnings) == (sensor, 5, ())
    assert recording.origin.kind is OriginKind.SIDECAR
    assert recording.path.stat().st_size == 5 * sensor.frame_bytes
    compact = random_frames(sensor, 5)
    np.testing.assert_array_equal(recording.compact(0, 5), compact)
    bits = np.unpackbits(compact[3], bitorder="little").reshape(sensor.height, sensor.width).astype(bool)
    np.testing.assert_array_equal(recording.frame(3), bits[::-1] if sensor.flipped else bits)
    assert [first for first, _ in recording.chunks(2)] == [0, 2, 4]


def test_the_first_stored_bit_is_the_left_pixel_of_the_bottom_row(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_bytes(bytes([1, 0]) + bytes(2))
    upright = open_recording(tmp_path / "a.dat", width=16, height=2).frame(0)
    assert np.argwhere(upright).tolist() == [[1, 0]]


def edited(path: Path, **fields: object) -> Path:
    """Change fields of a sidecar."""
    beside = sidecar_path(path)
    beside.write_text(json.dumps({**json.loads(beside.read_text()), **fields}))
    return path


def test_gaps_that_overlap_are_a_contradiction(tmp_path: Path) -> None:
    """Frames after them would have two numbers."""
    written(tmp_path / "a.dat", SENSORS["A"])
    gaps = [{"first": 4, "count": 10, "cause": "usb"}, {"first": 6, "count": 10, "cause": "usb"}]
    with pytest.raises(RecordingError, match="10 frames from 4 on and of 10 from 6 on overlap"):
        open_recording(edited(tmp_path / "a.dat", gaps=gaps))


def test_clock_pairs_out_of_order_are_left_out(tmp_path: Path) -> None:
    written(tmp_path / "a.dat", SENSORS["A"])
    pairs = [{"frame": 0, "unix_ns": 0}, *({"frame": 3, "unix_ns": at} for at in (10**9, 2 * 10**9, 3 * 10**9))]
    recording = open_recording(edited(tmp_path / "a.dat", clock=pairs))
    assert [pair.frame for pair in recording.clock] == [0, 3] and "2 of its 4 clock pairs" in recording.warnings[0]
    assert measured_rate(recording.clock) is None and recording.unix_ns([3]).tolist() == [10**9]


def test_what_lies_between_two_losses_is_known(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.dat", SENSORS["odd"]) as writer:
        for count, lost in ((5, 3), (4, 0), (6, 2), (1, 0)):
            writer.append(random_frames(SENSORS["odd"], count))
            if lost:
                writer.gap(writer.next_frame, lost, "usb")
    recording = open_recording(tmp_path / "a.dat")
    assert [recording.unbroken(k) for k in (0, 4, 5, 14, 15)] == [(0, 5), (0, 5), (5, 15), (5, 15), (15, 16)]


def test_a_recording_can_be_begun_again_beside_a_strange_index(tmp_path: Path) -> None:
    (tmp_path / "a.index").write_bytes(b"old")
    with pytest.raises(RecordingError, match=r"a\.index"):
        RecordingWriter(tmp_path / "a.dat", SENSORS["A"], durability=Durability(index=True))
    assert [file.name for file in tmp_path.iterdir()] == ["a.index"]


def test_reading_is_a_view_of_a_memory_map(tmp_path: Path) -> None:
    recording = written(tmp_path / "a.dat", SENSORS["A"])
    assert np.shares_memory(recording.read(1, 2), recording.data)
    assert np.shares_memory(recording.compact(1, 2), recording.data)
    assert not recording.data.flags.writeable
    with pytest.raises(RecordingError, match="not within its 5 frames"):
        recording.read(3, 3)


def test_what_was_read_does_not_stay_in_memory(tmp_path: Path) -> None:
    path, frames = tmp_path / "long.dat", 16_000
    with path.open("wb") as file:
        file.truncate(frames * 12_500)  # 200 MB without blocks on the disk
    recording = open_recording(path, width=400, height=250)
    kept = recording.read(0, 64)
    before = resident_file_bytes()
    for first in range(0, frames, 64):
        assert not recording.read(first, 64)[:, ::4096].any()
    assert resident_file_bytes() - before < 100e6
    assert not kept.any()


def resident_file_bytes() -> int:
    """Bytes of mapped files in the memory of this process."""
    status = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in status if line.startswith("RssFile"))


def test_the_sidecar_has_the_fields_of_the_streams(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    with RecordingWriter(path, SENSORS["A"], device={"serial": "7"}) as writer:
        writer.append(random_frames(SENSORS["A"], 2))
        writer.gap(1, 10, "usb")
        writer.clock_pair(0, 123)
    content = json.loads(sidecar_path(path).read_text())
    assert {k: content[k] for k in ("format", "width", "height", "frame_rate", "frames", "bit_order", "flipped")} == {
        "format": "compact",
        "width": 400,
        "height": 250,
        "frame_rate": 20000,
        "frames": 2,
        "bit_order": "lsb",
        "flipped": True,
    }
    assert content["cfa"] is None and content["pixel_centre"] == 0.5
    assert content["intrinsics"] == {"fx": 346.5, "fy": 346.5, "cx": 200.0, "cy": 125.0}
    assert content["device"] == {"serial": "7"}
    recording = open_recording(path)
    assert recording.gaps == (Gap(first=1, count=10, cause="usb"),)
    assert [recording.capture_index(k) for k in range(2)] == [0, 11]
    assert recording.clock[0].unix_ns == 123


@with_shared
@pytest.mark.parametrize("name", ["living", "garden", "garden_fast", "camp_color"])
def test_the_streams_open_by_their_sidecars(name: str) -> None:
    path = SHARED / "streams" / name / f"{name}.dat"
    recording = open_recording(path)
    content = json.loads(sidecar_path(path).read_text())
    assert (recording.frames, recording.sensor.width) == (content["frames"], content["width"])
    assert recording.sensor.mosaic == content["cfa"]
    assert recording.sensor.intrinsics is not None and recording.sensor.intrinsics.fx == content["intrinsics"]["fx"]
    assert recording.warnings == ()


@with_shared
@pytest.mark.parametrize(
    ("name", "spikes"),
    [("reds_rocks", 8_658_838), ("reds_arcade", 6_497_164), ("car_100kmh", 7_324_316), ("static_fence", 11_003_273)],
)
def test_the_real_clips_hold_the_known_spikes(name: str, spikes: int) -> None:
    result = verify(SHARED / "real" / f"{name}.dat", width=400, height=250)
    assert (result.spikes, result.verdict) == (spikes, "good")
    assert result.recording.origin.kind is OriginKind.GIVEN


@with_shared
@pytest.mark.parametrize(
    ("bit_order", "flipped", "decibels"),
    [(BitOrder.LSB, True, 31.6), (BitOrder.MSB, True, 25.4), (BitOrder.LSB, False, 11.8)],
)
def test_a_real_clip_matches_its_picture_only_when_decoded_right(
    bit_order: BitOrder, flipped: bool, decibels: float
) -> None:
    path = SHARED / "real" / "reds_rocks.dat"
    recording = open_recording(path, width=400, height=250, bit_order=bit_order, flipped=flipped)
    mean = np.mean([recording.frame(k) for k in range(130, 171)], axis=0) / 0.6
    picture = np.asarray(Image.open(path.with_name("reds_rocks_frame150.png")).convert("L")) / 255
    error = np.mean((np.clip(mean, 0, 1) - picture) ** 2)
    assert round(float(-10 * np.log10(error)), 1) == decibels


@with_shared
def test_the_frame_on_the_wire_is_a_row_tagged_frame_of_311_spikes(tmp_path: Path) -> None:
    wire = (SHARED / "wire" / "sps10_002_ep82_contiguous.bin").read_bytes()
    headers = [at for at in range(0, len(wire) - 13_016, 4) if wire[at : at + 4] == bytes.fromhex("00636063")]
    frames = []
    for at in headers:
        (tmp_path / f"{at}.dat").write_bytes(wire[at + 16 : at + 13_016])
        try:
            frames.append(verify(tmp_path / f"{at}.dat", layout=Layout.ROW_TAGGED, width=400, height=250))
        except RecordingError:
            continue
    whole = [frame for frame in frames if frame.wrong_tags == 0]
    assert [frame.spikes for frame in whole] == [311]


@with_shared
def test_a_size_that_only_one_flavour_has_is_guessed_and_said() -> None:
    recording = open_recording(SHARED / "real" / "reds_rocks.dat")
    assert recording.origin.kind is OriginKind.GUESSED
    assert "compact 400x250" in recording.origin.sentence and "20000 Hz" in recording.origin.sentence
    assert recording.frames == 301


def test_row_numbers_tell_a_row_tagged_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.dat", SENSORS["B"], 30).path
    sidecar_path(path).unlink()
    recording = open_recording(path)
    assert (recording.origin.kind, recording.sensor.layout) == (OriginKind.GUESSED, Layout.ROW_TAGGED)


def test_a_size_of_several_flavours_is_not_guessed(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_bytes(bytes(125_000))
    with pytest.raises(RecordingError, match=r"compact 400x250 \(10 frames\) or compact 1000x1000 \(1 frames\)"):
        open_recording(tmp_path / "a.dat")


@pytest.mark.parametrize("folder", [".", "train"])
def test_spikecv_configuration_gives_size_and_labels(tmp_path: Path, folder: str) -> None:
    (tmp_path / "config.yaml").write_text(
        "filename: x\nspike_w: 400\nspike_h: 250\nis_labeled: true\nlabeled_data_type: [3.1, 5]\n"
    )
    path = tmp_path / folder / "a.dat"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(bytes(125_000))
    recording = open_recording(path, frame_rate_hz=40_000)
    assert (recording.frames, recording.sensor.frame_rate_hz, recording.label_types) == (10, 40_000, (3.1, 5.0))
    assert "config.yaml" in recording.origin.sentence
    (tmp_path / "config.yaml").write_text("spike_w: wide\nspike_h: 250\n")
    with pytest.raises(RecordingError, match=r"config.yaml: field 'spike_w' is 'wide'"):
        open_recording(path)


def test_what_is_given_wins_over_the_sidecar_with_a_warning(tmp_path: Path) -> None:
    path = written(tmp_path / "a.dat", SENSORS["A"]).path
    recording = open_recording(path, frame_rate_hz=40_000, width=400)
    assert recording.sensor.frame_rate_hz == 40_000
    assert recording.origin.kind is OriginKind.GIVEN
    assert "frame_rate_hz 40000 (not 20000.0)" in recording.warnings[0]


KILLED = """
import os, signal, sys
import numpy as np
from spiked.recording import RecordingWriter
from spiked.sensor import Sensor
writer = RecordingWriter(sys.argv[1], Sensor(400, 250, 20_000.0))
writer.append(np.full((3, 12_500), 0x55, np.uint8))
with open(sys.argv[1], "ab", buffering=0) as torn:
    torn.write(bytes(100))
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_recording_is_valid_up_to_its_last_whole_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    assert subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False).returncode == -9
    recording = open_recording(path)
    assert (recording.frames, recording.trailing_bytes) == (3, 100)
    assert any("truncated to 100 of 12500" in warning for warning in recording.warnings)
    assert any("was not finished" in warning for warning in recording.warnings)
    assert verify(path).verdict == "degraded"


def test_nothing_that_exists_is_overwritten(tmp_path: Path) -> None:
    path = written(tmp_path / "a.dat", SENSORS["A"]).path
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="exists already"):
        RecordingWriter(path, SENSORS["A"])
    assert path.read_bytes() == before


def test_a_full_disk_is_an_error_that_says_what_is_safe() -> None:
    # The limit on file size refuses the write in the kernel, as a full disk does.
    code = """
import resource, signal, sys, tempfile
import numpy as np
from pathlib import Path
from spiked.errors import RecordingError
from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Sensor
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))
path = Path(tempfile.mkdtemp()) / "a.dat"
with RecordingWriter(path, Sensor(400, 250, 20_000.0)) as writer:
    writer.append(np.zeros((2, 12_500), np.uint8))
    try:
        writer.append(np.zeros((2, 12_500), np.uint8))
    except RecordingError as error:
        print(error)
print(open_recording(path).frames, path.stat().st_size)
"""
    result = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert "the first 2 frames are safe" in result.stdout
    assert result.stdout.split()[-2:] == ["2", "25000"]
