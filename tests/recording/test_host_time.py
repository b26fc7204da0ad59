"""Host time of frames, by the clock pairs of a sidecar."""

from pathlib import Path

import numpy as np
import pytest

from spiked.errors import RecordingError
from spiked.recording import RecordingWriter, open_recording
from spiked.recording.host_time import host_times_ns
from spiked.recording.sidecar import ClockPair
from spiked.sensor import Sensor

START_NS = 1_800_000_000_000_000_000


def pairs(*points: tuple[int, int]) -> list[ClockPair]:
    return [ClockPair(frame=frame, unix_ns=START_NS + ns) for frame, ns in points]


def test_between_pairs_by_a_line_and_outside_by_their_rate() -> None:
    known = pairs((1000, 1_010_000_000), (2000, 2_020_000_000), (4000, 4_020_000_000))
    times = host_times_ns(known, [0, 1000, 1500, 3000, 5000], 1000.0) - START_NS
    by_all = 3_010_000_000 / 3000
    expected = [1_010_000_000 - 1000 * by_all, 1_010_000_000, 1_515_000_000, 3_020_000_000]
    np.testing.assert_allclose(times, [*expected, 4_020_000_000 + 1000 * by_all], atol=1)


def test_few_pairs_leave_the_rate_to_the_sidecar() -> None:
    for known in (pairs((500, 7)), pairs((500, 7), (501, 900_000))):
        assert host_times_ns(known, 400, 1000.0) == START_NS + 7 - 100_000_000


def test_a_recording_says_when_its_frames_came(tmp_path: Path) -> None:
    sensor = Sensor(16, 8, 1000.0)
    for name, known in (("a", pairs((0, 5), (9, 9_000_005))), ("b", [])):
        with RecordingWriter(tmp_path / f"{name}.dat", sensor) as writer:
            writer.append(np.zeros((10, sensor.frame_bytes), np.uint8))
            for pair in known:
                writer.clock_pair(pair.frame, pair.unix_ns)
    assert open_recording(tmp_path / "a.dat").unix_ns([3]).tolist() == [START_NS + 3_000_005]
    with pytest.raises(RecordingError, match="no clock pairs"):
        open_recording(tmp_path / "b.dat").unix_ns(0)
