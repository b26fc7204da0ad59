"""Host time of frames, by the clock pairs of a sidecar."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spiked.errors import RecordingError
from spiked.recording import RecordingWriter, open_recording
from spiked.recording.host_time import host_times_ns
from spiked.recording.sidecar import ClockPair
from spiked.recording.time_base import measured_rate, offset
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


def recorded(
    path: Path, rate_hz: float, start_s: float, pairs: int, noise_s: float = 0.0, drift_ppm_s: float = 0.0
) -> Path:
    """A recording stated at 1,000 Hz whose frames came at `rate_hz`, the first at `start_s`; four pairs a second."""
    sensor, rng = Sensor(16, 8, 1000.0), np.random.default_rng(len(path.name))
    with RecordingWriter(path, sensor) as writer:
        writer.append(np.zeros((250 * pairs, sensor.frame_bytes), np.uint8))
        for frame in range(0, 250 * pairs, 250):
            seconds = frame / rate_hz
            came_s = start_s + seconds - 0.5e-6 * drift_ppm_s * seconds**2 + noise_s * rng.standard_normal()
            writer.clock_pair(frame, START_NS + round(1e9 * came_s))
    return path


def test_the_rate_is_measured_with_its_error_and_its_drift(tmp_path: Path) -> None:
    drifting = open_recording(recorded(tmp_path / "a.dat", 1000.2, 0.0, 40, noise_s=5e-6, drift_ppm_s=3.0))
    found = measured_rate(drifting.clock)
    assert found is not None and found.drift_ppm_s is not None
    middle_hz = 1000.2 * (1 + 3e-6 * 5)
    assert found.hz == pytest.approx(middle_hz, abs=5 * found.sigma_hz) and found.sigma_hz < 1e-3
    assert found.drift_ppm_s == pytest.approx(3.0, abs=0.5)
    assert found.jitter_s == pytest.approx(5e-6, rel=0.5)
    short = measured_rate(drifting.clock[:5])
    assert short is not None and short.drift_ppm_s is None
    assert measured_rate(drifting.clock[:3]) is None


def test_a_frame_of_one_camera_is_found_in_the_count_of_another(tmp_path: Path) -> None:
    first = open_recording(recorded(tmp_path / "left.dat", 1000.0, 0.0, 20, noise_s=2e-5))
    second = open_recording(recorded(tmp_path / "right-hand.dat", 999.5, 0.3203, 20, noise_s=2e-5))
    found = offset(first, second)
    assert found.sigma_s is not None and 7e-5 < found.sigma_s < 8e-5
    assert found.seconds == pytest.approx(0.3203, abs=1e-4)
    at = np.array([0, 500, 4000])
    np.testing.assert_allclose(found.frames_of_second(at), (at / 1000.0 - 0.3203) * 999.5, atol=0.1)
    back = offset(second, first)
    assert back.seconds == pytest.approx(-found.seconds)
    np.testing.assert_allclose(back.frames_of_second(found.frames_of_second(at)), at, atol=1e-3)


def test_an_offset_needs_clock_pairs_of_both(tmp_path: Path) -> None:
    good = open_recording(recorded(tmp_path / "a.dat", 1000.0, 0.0, 8))
    assert offset(good, replace(good, clock=good.clock[:2])).sigma_s is None
    for pair in ((good, replace(good, clock=())), (replace(good, clock=()), good)):
        with pytest.raises(RecordingError, match="no clock pairs"):
            offset(*pair)
