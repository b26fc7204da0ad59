"""`spiked cut`: a range of a recording."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import RecordingError, SpikedError
from spiked.recording import Durability, RecordingWriter, Verdict, index_path, open_recording, read_index, verify
from spiked.recording.cut import cut_recording
from spiked.sensor import BitOrder, Layout, Sensor
from spiked.trajectory import Trajectory

RATE = 20_000.0


def written(file: Path, sensor: Sensor, *, index: bool = False) -> Path:
    """300 frames of the capture: 0 to 99 stored, 100 to 119 lost, 120 to 299 stored, by some spikes of chance."""
    spikes = np.random.default_rng(0).integers(0, 256, (280, sensor.compact().frame_bytes), np.uint8)
    with RecordingWriter(file, sensor, durability=Durability(index=index), note="mine", rig="left") as writer:
        writer.clock_pair(0, 10**18)
        writer.append(spikes[:100])
        writer.gap(100, 20, "usb")
        writer.append(spikes[100:])
        writer.clock_pair(299, 10**18 + round(299e9 / RATE))
    return file


@pytest.mark.parametrize("layout", Layout)
@pytest.mark.parametrize("order", BitOrder)
@pytest.mark.parametrize(("begin", "end"), [(0, 300), (50, 110), (110, 115 + 6), (130, 131), (90, 280)])
def test_frames_keep_their_bits_and_places(
    tmp_path: Path, layout: Layout, order: BitOrder, begin: int, end: int
) -> None:
    whole = open_recording(written(tmp_path / "rec.dat", Sensor(32, 16, RATE, layout, order), index=True))
    cut_recording(whole, tmp_path / "part.dat", begin, end)
    part = open_recording(tmp_path / "part.dat")
    assert part.sensor == whole.sensor and not part.warnings
    for frame in range(begin, end):
        a, b = whole.captured(frame, 1), part.captured(frame - begin, 1)
        assert (a is None) == (b is None) and (a is None or b is None or np.array_equal(a, b))
    assert np.array_equal(part.unix_ns([0, end - begin - 1]), whole.unix_ns([begin, end - 1]))
    assert read_index(index_path(part.path)).frames == part.frames
    assert verify(part.path).verdict in {Verdict.GOOD, Verdict.DEGRADED}  # degraded by its gap alone
    sidecar = json.loads((tmp_path / "part.json").read_text())
    assert (sidecar["first_frame"], sidecar["note"], sidecar["rig"]) == (begin, "mine", "left")


@pytest.mark.parametrize(("begin", "end"), [(0, 301), (-1, 5), (7, 7), (9, 3)])
def test_a_range_outside_is_refused(tmp_path: Path, begin: int, end: int) -> None:
    whole = open_recording(written(tmp_path / "rec.dat", Sensor(32, 16, RATE)))
    with pytest.raises(RecordingError, match="0:300"):
        cut_recording(whole, tmp_path / "part.dat", begin, end)
    with pytest.raises(RecordingError, match="lost"):
        cut_recording(whole, tmp_path / "part.dat", 105, 115)
    assert not (tmp_path / "part.dat").exists()


def test_damaged_frames_get_no_new_checksum(tmp_path: Path) -> None:
    file = written(tmp_path / "rec.dat", Sensor(32, 16, RATE), index=True)
    with file.open("r+b") as data:
        data.seek(150 * 64)
        data.write(b"\xff\x00\xff")
    whole = open_recording(file)
    with pytest.raises(RecordingError, match="120:300 differ from their checksum"):
        cut_recording(whole, tmp_path / "part.dat", 110, 140)
    assert cut_recording(whole, tmp_path / "part.dat", 10, 110) == (90, 10)


def test_truth_is_cut_along(tmp_path: Path) -> None:
    file = written(tmp_path / "rec.dat", Sensor(32, 16, RATE))
    times = (np.arange(300) + 0.5) / RATE
    centres = np.outer(np.arange(300.0), [1, 2, 3])
    Trajectory(times, np.tile(np.eye(3), (300, 1, 1)), centres).write_tum(tmp_path / "groundtruth.tum")
    (tmp_path / "views").mkdir()
    views = []
    for number, at in enumerate((0.001, 0.006, 0.009)):
        (tmp_path / f"views/{number}.png").write_bytes(bytes([number]))
        views.append({"file": f"views/{number}.png", "timestamp": at, "c2w": np.eye(4).tolist(), "coverage": 1.0})
    (tmp_path / "views.json").write_text(json.dumps({"gain": 0.3, "views": views}))
    part = tmp_path / "part"
    part.mkdir()
    done = CliRunner().invoke(app, ["cut", str(file), "-o", str(part / "rec.dat"), "--seconds", "0.005:0.01"])
    assert done.exit_code == 0 and "frames 100:200" in done.output and "views.json" in done.output
    path = Trajectory.read_tum(part / "groundtruth.tum")
    assert np.allclose(path.times_s, times[:100]) and np.allclose(path.centres, centres[100:200])
    table = json.loads((part / "views.json").read_text())
    assert [view["file"] for view in table["views"]] == ["views/1.png", "views/2.png"] and table["gain"] == 0.3
    assert table["views"][0]["timestamp"] == pytest.approx(0.001) and (part / "views/2.png").read_bytes() == b"\x02"
    again = CliRunner().invoke(app, ["cut", str(file), "-o", str(part / "other.dat"), "--frames", ":100"])
    assert "groundtruth.tum exists already" in str(again.exception)


@pytest.mark.parametrize("text", ["5", "a:b", "1:2:3", "-5:3"])
def test_what_is_no_range_is_said(tmp_path: Path, text: str) -> None:
    file = written(tmp_path / "rec.dat", Sensor(32, 16, RATE))
    for option in (f"--frames={text}", f"--seconds={text}"):
        done = CliRunner().invoke(app, ["cut", str(file), "-o", str(tmp_path / "part.dat"), option])
        assert done.exit_code == 2 and "range" in done.output


def test_a_cut_whose_truth_cannot_be_written_can_be_repeated(tmp_path: Path) -> None:
    file = written(tmp_path / "rec.dat", Sensor(32, 16, RATE))
    view = {"file": "views/0.png", "timestamp": 0.001}
    (tmp_path / "part").mkdir()
    arguments = ["cut", str(file), "-o", str(tmp_path / "part" / "rec.dat"), "--frames", ":100"]
    for name, said in (("views/0.png", "No such file"), ("../elsewhere.png", "outside of its folder")):
        (tmp_path / "views.json").write_text(json.dumps({"views": [{**view, "file": name}]}))
        done = CliRunner().invoke(app, arguments)
        assert isinstance(done.exception, SpikedError) and said in str(done.exception)
        assert list((tmp_path / "part").iterdir()) == []
    (tmp_path / "views").mkdir()
    (tmp_path / "views" / "0.png").write_bytes(b"picture")
    (tmp_path / "views.json").write_text(json.dumps({"views": [view]}))
    assert CliRunner().invoke(app, arguments).exit_code == 0


def test_nothing_is_left_of_a_cut_without_room(tmp_path: Path) -> None:
    """Its first frames would pass for the whole range."""
    written(tmp_path / "rec.dat", Sensor(400, 248, RATE), index=True)

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    command = [sys.executable, "-m", "spiked_service", "cut", "rec.dat", "-o", "part.dat", "--frames", "0:300"]
    done = subprocess.run(command, check=False, cwd=tmp_path, preexec_fn=limit, capture_output=True, text=True)
    assert done.returncode == 2 and "part.dat: cannot be written" in done.stderr
    assert not list(tmp_path.glob("part.*"))
    assert "Traceback" not in done.stderr
