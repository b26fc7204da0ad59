"""Each kind of bad input is one line that says what is wrong, and leaves the folder as it was."""

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from spiked.errors import RecordingError
from spiked.recording import RecordingWriter, open_recording, sidecar_path, verify
from spiked.sensor import Layout, Sensor

SENSOR = Sensor(400, 250, 20_000.0)


def refuse(path: Path, match: str, **given: Any) -> None:
    """Opening raises one line that names the file and matches; nothing in the folder changes."""
    before = sorted(path.parent.iterdir()) if path.parent.is_dir() else []
    with pytest.raises(RecordingError, match=match) as caught:
        open_recording(path, **given)
    message = str(caught.value)
    assert "\n" not in message and path.stem in message
    assert (sorted(path.parent.iterdir()) if path.parent.is_dir() else []) == before


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A good recording of four frames."""
    path = tmp_path / "a.dat"
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(np.random.default_rng(1).integers(0, 256, (4, 12_500), np.uint8))
    return path


def edit(path: Path, **fields: Any) -> None:
    """Change fields of a recording's sidecar; None removes one."""
    beside = sidecar_path(path)
    content = json.loads(beside.read_text()) | fields
    beside.write_text(json.dumps({k: v for k, v in content.items() if k not in fields or v is not None}))


def picture(kind: str) -> bytes:
    file = io.BytesIO()
    Image.new("L", (400, 250)).save(file, kind)
    return file.getvalue()


def archive() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as content:
        content.writestr("a", "b")
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "what"),
    [(picture("PNG"), "PNG picture"), (picture("JPEG"), "JPEG picture"), (archive(), "ZIP archive")],
)
def test_other_files_named_dat(tmp_path: Path, content: bytes, what: str) -> None:
    path = tmp_path / "a.dat"
    path.write_bytes(content)
    refuse(path, what)
    refuse(path, what, width=8, height=1)


def test_empty_file(tmp_path: Path) -> None:
    (tmp_path / "a.dat").touch()
    refuse(tmp_path / "a.dat", "the file is empty")


def test_directory(tmp_path: Path) -> None:
    refuse(tmp_path, "is a directory")


def test_missing_file_and_file_as_folder(tmp_path: Path) -> None:
    refuse(tmp_path / "a.dat", "No such file")
    (tmp_path / "a.dat").touch()
    refuse(tmp_path / "a.dat" / "b.dat", "Not a directory")


def test_unreadable_file(tmp_path: Path, recorded: Path) -> None:
    recorded.chmod(0)
    root = os.geteuid() == 0
    if root:
        # Root may read anything, so be somebody else for the moment of opening.
        for folder in [tmp_path, *tmp_path.parents]:
            if folder.stat().st_uid == 0 and folder.is_relative_to(Path("/tmp")) and folder != Path("/tmp"):
                folder.chmod(0o755)
        os.seteuid(65534)
    try:
        refuse(recorded, "Permission denied")
    finally:
        if root:
            os.seteuid(0)


def test_size_that_fits_no_flavour(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_bytes(bytes(12_501))
    refuse(tmp_path / "a.dat", "12501 bytes fit no known flavour.*give its width and height")


def test_wire_data_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_bytes(bytes.fromhex("0063606321001000") + bytes(13_008))
    refuse(tmp_path / "a.dat", "USB3 wire data")


def test_less_than_a_frame(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_bytes(bytes(100))
    refuse(tmp_path / "a.dat", "less than one frame of 400x250", width=400, height=250)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"width": 400}, "both width and height"),
        ({"width": 401, "height": 250}, "multiple of 8"),
        ({"width": 400, "height": 250, "frame_rate_hz": -1.0}, "not a positive number"),
    ],
)
def test_impossible_arguments(tmp_path: Path, given: dict[str, Any], match: str) -> None:
    (tmp_path / "a.dat").write_bytes(bytes(12_500))
    refuse(tmp_path / "a.dat", match, **given)


def test_truncated_last_frame_is_a_warning(recorded: Path) -> None:
    with recorded.open("r+b") as file:
        file.truncate(4 * 12_500 - 1)
    recording = open_recording(recorded)
    assert recording.frames == 3
    assert recording.warnings == ("the last frame is truncated to 12499 of 12500 bytes and is ignored",)
    result = verify(recorded)
    assert (result.verdict, result.reasons) == ("degraded", recording.warnings)


def test_wrong_row_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    path.write_bytes(bytes(26_000))
    refuse(path, "row numbers of frame 0", width=400, height=250, layout=Layout.ROW_TAGGED)
    result = verify(path, width=400, height=250, layout=Layout.ROW_TAGGED)
    assert (result.verdict, result.wrong_tags) == ("bad", 2)


def test_one_wrong_row_number_is_found_by_verify(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    with RecordingWriter(path, Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED)) as writer:
        writer.append(np.full((8, 12_500), 0x11, np.uint8))
    with path.open("r+b") as file:
        file.seek(13_000 + 50)
        file.write(b"\x07")
    refuse(path, "row numbers of frame 1")
    result = verify(path)
    assert (result.verdict, result.wrong_tags) == ("bad", 1)
    assert result.reasons[-1] == "1 of 8 frames have wrong row numbers"


def test_a_wrong_row_number_anywhere_in_a_short_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    with RecordingWriter(path, Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED)) as writer:
        writer.append(np.full((20, 12_500), 0x11, np.uint8))
    sidecar_path(path).unlink()
    stored = bytearray(path.read_bytes())
    stored[5 * 13_000 + 50] = 7
    path.write_bytes(stored)
    refuse(path, "row numbers of frame 5")
    stored[50] = 7
    path.write_bytes(stored)
    refuse(path, "looks row-tagged")


def test_a_row_tagged_file_cut_within_a_frame_is_still_told_by_its_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    with RecordingWriter(path, Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED)) as writer:
        writer.append(np.full((4, 12_500), 0x11, np.uint8))
    sidecar_path(path).unlink()
    path.write_bytes(path.read_bytes()[:-100])
    recording = open_recording(path)
    assert (recording.frames, recording.sensor.layout) == (3, Layout.ROW_TAGGED)
    assert "truncated" in recording.warnings[-1]


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"frames": 5}, "says 5 frames of 400x250, but the file's 50000 bytes hold 4"),
        ({"frames": 3}, "says 3 frames"),
        ({"width": 800}, "says 4 frames of 800x250"),
        ({"width": 401}, "multiple of 8"),
        ({"height": 0}, "'height' is 0"),
        ({"width": "400"}, "'width' is '400'"),
        ({"frame_rate": -20000}, "'frame_rate' is -20000"),
        ({"bit_order": "middle"}, "'bit_order' is 'middle'"),
        ({"format": "zipped"}, "'format' is 'zipped'"),
        ({"cfa": "RGBW"}, "'cfa' is 'RGBW'"),
        ({"intrinsics": {"fx": 0, "fy": 1, "cx": 1, "cy": 1}}, "'intrinsics.fx' is 0"),
        ({"gaps": [{"first": -1, "count": 1, "cause": "usb"}]}, "'gaps.0.first' is -1"),
        ({"height": None}, "'height' is missing"),
        ({"frames": None}, "'frames' is missing"),
    ],
)
def test_contradicting_sidecar(recorded: Path, fields: dict[str, Any], match: str) -> None:
    edit(recorded, **fields)
    refuse(recorded, match)


@pytest.mark.parametrize("content", [b"{", b"[]", b"", b"\xff\xfe"])
def test_sidecar_that_is_not_a_json_object(recorded: Path, content: bytes) -> None:
    sidecar_path(recorded).write_bytes(content)
    refuse(recorded, r"a\.json: not a JSON object")


def test_verify_judges_a_contradicting_sidecar_bad(recorded: Path) -> None:
    edit(recorded, frames=77)
    result = verify(recorded)
    assert result.verdict == "bad"
    assert "says 77 frames" in result.reasons[0]


def test_verify_finds_dead_and_stuck_rows_where_the_picture_shows_them(tmp_path: Path) -> None:
    frames = np.random.default_rng(2).integers(0, 256, (6, 250, 50), np.uint8)
    frames[:, 0] = 0
    frames[:, 9] = 255
    with RecordingWriter(tmp_path / "a.dat", SENSOR) as writer:
        writer.append(frames.reshape(6, -1))
    result = verify(tmp_path / "a.dat")
    assert (result.dead_rows, result.stuck_rows, result.verdict) == ((249,), (240,), "degraded")
    assert result.reasons == ("1 rows never fire: 249", "1 rows always fire: 240")


def test_verify_judges_darkness_bad_and_names_gaps(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.dat", SENSOR) as writer:
        writer.append(np.zeros((2, 12_500), np.uint8))
        writer.gap(2, 7, "usb")
    result = verify(tmp_path / "a.dat")
    assert result.verdict == "bad"
    assert result.reasons == ("no pixel ever fires", "7 frames were lost in 1 gaps")
