"""Recordings of an even light and of the dark, as a calibration takes them, and sources that show one or the other."""

from pathlib import Path

import numpy as np

from spiked.recording import RecordingWriter
from spiked.sensor import Sensor
from spiked.simulate import SensorNoise
from spiked.simulate.sensor import SpikeSensor

NOISE = SensorNoise(dead_share=0.005, hot_share=0.005)


def pixels(sensor: Sensor) -> SpikeSensor:
    """Those of all recordings of a sensor: every time the same dead and hot ones."""
    return SpikeSensor(sensor, 2, NOISE)


def still(path: Path, sensor: Sensor, light: float, frames: int = 600) -> Path:
    """A recording of an even light through a lens that darkens corners by 30 %; 0: with the lens covered."""
    x, y = np.meshgrid(np.linspace(-1, 1, sensor.width), np.linspace(-1, 1, sensor.height))
    image = (light * (1 - 0.15 * (x**2 + y**2))).astype(np.float32)
    with RecordingWriter(path, sensor) as writer:
        writer.append(pixels(sensor).expose(image, image, np.zeros(frames, np.float32)))
    return path


def place(at: Path, recording: Path) -> None:
    """Let a source that names `at` show another recording."""
    for suffix in (".dat", ".json"):
        at.with_suffix(suffix).unlink(missing_ok=True)
        at.with_suffix(suffix).symlink_to(recording.with_suffix(suffix))
