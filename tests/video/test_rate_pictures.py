"""Slow motion of a recording whose light is known."""

from pathlib import Path

import numpy as np
import pytest

from spiked.errors import ConfigurationError
from spiked.recording import Recording, RecordingWriter, open_recording
from spiked.sensor import Mosaic, Sensor
from spiked.simulate import SimulatedCamera
from spiked.video import SlowMotion, slow_motion
from spiked.video.rate_pictures import MOST_PICTURES

SENSOR = Sensor(200, 125, 2000.0)
FRAMES = 400


def camera() -> SimulatedCamera:
    """Shaken in the built-in room."""
    return SimulatedCamera(SENSOR, seed=4)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """200 ms."""
    path = tmp_path_factory.mktemp("room") / "room.dat"
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(camera().next_frames(FRAMES))
    return open_recording(path)


def test_pictures_are_evenly_spaced_in_the_part(recording: Recording) -> None:
    times = SlowMotion(slower=50, pictures_a_second=20, begin_s=0.05, end_s=0.1).times_s(recording)
    assert len(times) == 50
    np.testing.assert_allclose(np.diff(times), 0.001)
    assert times[0] == pytest.approx(0.0505) and times[-1] == pytest.approx(0.0995)
    assert len(SlowMotion(slower=50, pictures_a_second=20).times_s(recording)) == 200


def psnr(recording: Recording, how: SlowMotion) -> float:
    """Mean over the pictures, after the best common brightness; of the exact light at their times."""
    found = []
    for time_s, picture in zip(how.times_s(recording), slow_motion(recording, how), strict=True):
        assert picture is not None and picture.dtype == np.uint8
        rotations, centres = camera().truth([time_s * SENSOR.frame_rate_hz - 0.5])
        exact = camera().view(rotations[0], centres[0]).astype(float)
        grey = picture.astype(float)
        grey *= (grey * exact).sum() / (grey * grey).sum()
        found.append(-10 * np.log10(np.mean((grey - exact) ** 2) / exact.max() ** 2))
    return float(np.mean(found))


def test_compensation_takes_noise_at_the_same_blur(recording: Recording) -> None:
    how = SlowMotion(slower=5, pictures_a_second=10, begin_s=0.02, end_s=0.18, window=8)
    plain = psnr(recording, how)
    added = psnr(recording, SlowMotion(5, 10, window=8, compensated=True, begin_s=0.02, end_s=0.18))
    assert plain > 22
    assert added > plain + 1.5


def test_lost_frames_are_no_picture(tmp_path: Path) -> None:
    frames = camera().next_frames(200)
    with RecordingWriter(tmp_path / "a.dat", SENSOR) as writer:
        writer.append(frames[:80])
        writer.gap(80, 40, "usb")
        writer.append(frames[120:])
    pictures = list(slow_motion(open_recording(tmp_path / "a.dat"), SlowMotion(100, 20, window=4)))
    assert len(pictures) == 200
    missing = [at for at, picture in enumerate(pictures) if picture is None]
    assert missing == list(range(missing[0], missing[-1] + 1))
    assert missing[0] == pytest.approx(80, abs=4) and missing[-1] == pytest.approx(120, abs=4)


def test_a_mosaic_has_colours(tmp_path: Path) -> None:
    sensor = Sensor(64, 48, 2000.0, mosaic=Mosaic("RGGB"))
    with RecordingWriter(tmp_path / "a.dat", sensor) as writer:
        writer.append(SimulatedCamera(sensor, seed=1).next_frames(64))
    (picture,) = slow_motion(open_recording(tmp_path / "a.dat"), SlowMotion(1, 1000 / 32, compensated=True))
    assert picture is not None and picture.shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (SlowMotion(0), "a factor above 0"),
        (SlowMotion(float("nan")), "a factor above 0"),
        (SlowMotion(10, window=0), "a window of 1 to 4096"),
        (SlowMotion(1, 1), "less than one picture"),
        (SlowMotion(1e9), f"more than {MOST_PICTURES:,}"),
        (SlowMotion(10, begin_s=3), "none of it lies between 3 s and its end"),
        (SlowMotion(10, begin_s=0.1, end_s=0.1), "between 0.1 s and 0.1 s"),
    ],
)
def test_what_shows_nothing_is_refused(how: SlowMotion, message: str, recording: Recording) -> None:
    with pytest.raises(ConfigurationError, match=message):
        next(slow_motion(recording, how))
