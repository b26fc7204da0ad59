"""What a recording is said to be worth after damage, and that looking at it destroys nothing."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from spiked_service.captures.recording_quality import reassess, recover_and_assess, recovered
from spiked_service.store.rows import Grade

from spiked.errors import RecordingError
from spiked.recording import Durability, Gap, RecordingWriter, index_path, sidecar_path
from spiked.sensor import Sensor

SENSOR = Sensor(64, 16, 1000.0)


@pytest.fixture
def unfinished(tmp_path: Path) -> Path:
    """40 frames with 100 lost after the first 16, of a recorder that was killed."""
    file = tmp_path / "a.dat"
    with RecordingWriter(file, SENSOR, durability=Durability(index=True)) as writer:
        for number in range(5):
            if number == 2:
                writer.gap(writer.next_frame, 100, "usb")
            writer.append(np.full((8, SENSOR.frame_bytes), number + 1, np.uint8))
    sidecar = json.loads(sidecar_path(file).read_text())
    sidecar_path(file).write_text(json.dumps({**sidecar, "frames": None, "gaps": []}))
    return file


def test_a_damaged_sidecar_does_not_cost_the_index(unfinished: Path) -> None:
    whole = sidecar_path(unfinished).read_text()
    sidecar_path(unfinished).write_text(whole[:40])
    with pytest.raises(RecordingError, match=r"a\.json"):
        recovered(unfinished)
    sidecar_path(unfinished).write_text(whole)
    found, problems = recovered(unfinished)
    assert (found.frames, found.sidecar.gaps, problems) == (40, (Gap(first=16, count=100, cause="usb"),), ())


def test_an_index_that_is_none_is_put_aside_and_told(unfinished: Path) -> None:
    index_path(unfinished).write_bytes(b"x" * 64)
    found, problems = recovered(unfinished)
    assert found.frames == 40 and "not an index" in problems[0]
    assert [file.name for file in sorted(unfinished.parent.iterdir())] == ["a.dat", "a.index.unreadable", "a.json"]


def test_frames_that_the_disk_has_lost_are_told(unfinished: Path) -> None:
    os.truncate(unfinished, 20 * SENSOR.frame_bytes)
    recording, quality, finished = reassess(unfinished)
    assert (recording.frames, quality.grade, finished) == (16, Grade.BAD, False)
    assert "24 frames after its first 16 were on the disk and are not in the file" in quality.reasons


def test_so_are_those_of_a_recorder_that_died(unfinished: Path) -> None:
    os.truncate(unfinished, 20 * SENSOR.frame_bytes)
    recording, quality = recover_and_assess(unfinished, "it was killed")
    assert recording is not None and recording.frames == 16 and quality.grade is not Grade.GOOD
    assert any(reason.startswith("24 frames after its first 16") for reason in quality.reasons)
