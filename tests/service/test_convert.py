"""Conversion keeps every frame's bits, and every gap that a form can tell of."""

import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spiked_service.cli.main import app
from spiked_service.conversion.form import Form
from spiked_service.conversion.reading import Item, read_content
from spiked_service.conversion.writing import write_content
from typer.testing import CliRunner

from spiked.errors import ConfigurationError, RecordingError
from spiked.recording import Gap, RecordingGeometry, RecordingWriter, open_recording
from spiked.sensor import BitOrder, Layout, Sensor

REAL = Path(__file__).parents[3] / "shared" / "wire" / "sps10_002_ep82_contiguous.bin"
SENSORS = {
    (400, 250): (Form.COMPACT, Form.ROW_TAGGED, Form.USB),
    (1000, 1000): (Form.COMPACT, Form.ROW_TAGGED, Form.PCIE),
    (320, 180): (Form.COMPACT, Form.ROW_TAGGED),
}


def converted(source: Path, out: Path, to: Form, form: Form | None = None) -> Path:
    write_content(read_content(source, form, RecordingGeometry(), print), out, to, print)
    return out


@settings(max_examples=25, deadline=None)
@given(
    data=st.data(),
    size=st.sampled_from(list(SENSORS)),
    layout=st.sampled_from(Layout),
    bit_order=st.sampled_from(BitOrder),
    count=st.integers(1, 6),
)
def test_any_chain_of_forms_ends_with_the_same_frames(
    data: st.DataObject, size: tuple[int, int], layout: Layout, bit_order: BitOrder, count: int
) -> None:
    sensor = Sensor(*size, 20_000.0, layout, bit_order)
    frames = np.random.default_rng(count).integers(0, 256, (count, sensor.compact().frame_bytes), np.uint8)
    chain = data.draw(st.lists(st.sampled_from(SENSORS[size]), max_size=4))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "0.dat"
        with RecordingWriter(path, sensor) as writer:
            writer.append(frames)
        for step, form in enumerate([*chain, Form.COMPACT], 1):
            path = converted(path, path.with_name(f"{step}.dat"), form)
        np.testing.assert_array_equal(open_recording(path).compact(0, count), frames)


def test_gaps_pass_through_the_usb_form(tmp_path: Path) -> None:
    sensor = Sensor(400, 250, 20_000.0)
    with RecordingWriter(tmp_path / "a.dat", sensor, note="kept") as writer:
        writer.append(np.full((5, 12_500), 7, np.uint8))
        writer.gap(2, 10, "device")
        writer.gap(13, 1, "device")
    converted(tmp_path / "a.dat", tmp_path / "b.usb", Form.USB)
    back = open_recording(converted(tmp_path / "b.usb", tmp_path / "c.dat", Form.ROW_TAGGED))
    assert back.gaps == (Gap(first=2, count=10, cause="device"), Gap(first=13, count=1, cause="device"))
    assert back.frames == 5
    assert back.sensor == Sensor(400, 250, 20_000.0, Layout.ROW_TAGGED)
    again = converted(tmp_path / "a.dat", tmp_path / "d.dat", Form.ROW_TAGGED)
    assert '"note": "kept"' in again.with_suffix(".json").read_text()


def test_a_size_that_a_form_cannot_hold_writes_nothing(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.dat", Sensor(320, 180, 20_000.0)) as writer:
        writer.append(np.zeros((2, 7200), np.uint8))
    with pytest.raises(ConfigurationError, match="400x250"):
        converted(tmp_path / "a.dat", tmp_path / "b.usb", Form.USB)
    assert not (tmp_path / "b.usb").exists()


def test_what_holds_no_frame_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(20_000))
    with pytest.raises(RecordingError, match="no whole frame"):
        converted(tmp_path / "a.bin", tmp_path / "b.dat", Form.COMPACT, Form.USB)
    assert not (tmp_path / "b.dat").exists()


@pytest.mark.skipif(not REAL.is_file(), reason="the real bytes in ../shared/wire are not here")
def test_the_command_finds_out_what_real_bytes_are(tmp_path: Path) -> None:
    out = tmp_path / "rec.dat"
    done = CliRunner().invoke(app, ["convert", str(REAL), str(out)])
    assert done.exit_code == 0
    recording = open_recording(out)
    assert int(np.bitwise_count(recording.compact(0, 1)).sum()) == 311
    assert [gap.count for gap in recording.gaps] == [241_231, 1]


def test_raw_bytes_appear_when_they_are_whole(tmp_path: Path) -> None:
    """A kill leaves no shorter file: raw bytes do not say how many there should be."""
    with RecordingWriter(tmp_path / "rec.dat", Sensor(400, 250, 20_000.0)) as writer:
        writer.append(np.zeros((3, 12_500), np.uint8))
    out, content = tmp_path / "rec.usb", read_content(tmp_path / "rec.dat", None, RecordingGeometry(), print)
    seen = []

    def watched(items: Iterator[Item]) -> Iterator[Item]:
        for item in items:
            yield item
            seen.append(out.exists())

    write_content(replace(content, items=watched(content.items)), out, Form.USB, print)
    assert seen and not any(seen) and out.stat().st_size > 3 * 12_500


def test_a_conversion_without_room_leaves_the_source_whole(tmp_path: Path) -> None:
    """Raw bytes beside the recording, of the same name: its sidecar is that of the source."""
    with RecordingWriter(tmp_path / "rec.dat", Sensor(400, 250, 20_000.0)) as writer:
        writer.append(np.zeros((300, 12_500), np.uint8))
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    command = [sys.executable, "-m", "spiked_service", "convert", "rec.dat", "rec.bin", "--to", "usb"]
    done = subprocess.run(command, check=False, cwd=tmp_path, preexec_fn=limit, capture_output=True, text=True)
    assert done.returncode == 2 and "rec.bin cannot be written" in done.stderr
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
