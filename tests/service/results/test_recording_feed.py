"""Feeding a recording with gaps to a reconstruction."""

from pathlib import Path

import numpy as np
from spiked_service.results.recording_feed import Piece, pieces

from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Sensor


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
