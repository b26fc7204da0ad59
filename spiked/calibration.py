"""A camera's per-pixel gain, dark rate and defects, from a recording in the dark and one of an even light."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.errors import CalibrationError
from spiked.recording import Recording
from spiked.sensor import Image, Sensor

__all__ = ["Calibration", "mean_rate"]

LONGEST_FRAMES = 60_000
"""Frames of a recording that are used: offsets have 16 bits."""
HOT_SHARE = 0.2
"""A pixel is hot if its dark rate exceeds this share of the even light's median rate."""
GAIN_LIMITS = (0.2, 4.0)
"""Pixels whose gain relative to the median lies outside are dead, or stuck."""


@dataclass(frozen=True)
class Calibration:
    """`rate = gain * light + dark` at each pixel of the upright image, [H, W]."""

    gain: Image
    """Relative sensitivity with the lens's vignetting; the mean log gain of good pixels is 0. 1 where dead."""
    dark: Image
    """Spikes a frame without light."""
    dead: NDArray[np.bool_]
    """Pixels to leave out: dead, stuck or hot."""

    def __post_init__(self) -> None:
        shape = self.gain.shape
        if len(shape) != 2 or self.dark.shape != shape or self.dead.shape != shape:
            raise CalibrationError("gain, dark and dead of a calibration must be images of one size")
        if not (np.isfinite(self.gain).all() and (self.gain > 0).all() and np.isfinite(self.dark).all()):
            raise CalibrationError("a calibration's gains must be positive and its dark rates finite")

    def check(self, sensor: Sensor) -> None:
        """Raises CalibrationError if it is of another sensor."""
        if self.gain.shape != (sensor.height, sensor.width):
            height, width = self.gain.shape
            raise CalibrationError(
                f"the calibration is of {width}x{height} pixels and the recording of {sensor.width}x{sensor.height}: "
                "calibrate with the same camera and geometry"
            )

    def apply(self, rate: Image, deviation: Image) -> tuple[Image, Image]:
        """Light and its deviation from a measured rate [H, W]; dead pixels take their neighbours', uncertain."""
        light = np.maximum(rate - self.dark, 0) / self.gain
        spread = deviation / self.gain
        if self.dead.any():
            light = np.where(self.dead, around(light, ~self.dead), light)
            spread = np.where(self.dead, np.float32(1e3), spread)
        return light.astype(np.float32), spread.astype(np.float32)

    def write(self, path: Path) -> None:
        """As a NumPy archive (.npz) with `gain`, `dark` (float32) and `dead` (bool). Raises CalibrationError."""
        try:
            with path.open("wb") as file:
                np.savez_compressed(file, gain=self.gain, dark=self.dark, dead=self.dead)
        except OSError as error:
            raise CalibrationError(f"cannot write {path}: {error.strerror}; choose another place") from error

    @classmethod
    def read(cls, path: Path) -> "Calibration":
        """Raises CalibrationError if the file is missing or not a calibration."""
        try:
            with np.load(path, allow_pickle=False) as archive:
                gain, dark, dead = (archive[name] for name in ("gain", "dark", "dead"))
        except OSError as error:
            raise CalibrationError(f"cannot read the calibration {path}: {error.strerror or error}") from error
        except (KeyError, ValueError, AttributeError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise CalibrationError(
                f"{path} is not a calibration: it must be an .npz of `spiked calibrate` with gain, dark and dead"
            ) from error
        return cls(gain.astype(np.float32), dark.astype(np.float32), dead.astype(bool))

    @classmethod
    def measure(cls, flat: Recording, dark: Recording | None) -> "Calibration":
        """From a recording of an even light and one with the cap on. Raises CalibrationError for unsuitable ones."""
        light = mean_rate(flat)
        sensor = flat.sensor
        if dark is not None and (dark.sensor.width, dark.sensor.height) != (sensor.width, sensor.height):
            raise CalibrationError(
                f"{dark.path} is of {dark.sensor.width}x{dark.sensor.height} pixels and {flat.path} of "
                f"{sensor.width}x{sensor.height}: they must be of one camera"
            )
        offset = np.zeros_like(light) if dark is None else mean_rate(dark)
        net = light - offset
        typical = _typical(net, sensor)
        if float(np.median(light)) < 0.005:
            raise CalibrationError(f"{flat.path} is too dark for a calibration: its median rate is below 0.005")
        if float(np.median(light)) > 0.95:
            raise CalibrationError(f"{flat.path} is saturated: use less light, pixels should fire every 2 to 20 frames")
        if dark is not None and float(np.median(offset)) > 0.5 * float(np.median(light)):
            raise CalibrationError(f"{dark.path} is not dark: it is more than half as bright as {flat.path}")
        gain = net / typical
        dead = (gain < GAIN_LIMITS[0]) | (gain > GAIN_LIMITS[1]) | (offset > HOT_SHARE * float(np.median(light)))
        gain = np.where(dead, 1, gain)
        gain[~dead] /= np.exp(np.log(gain[~dead]).mean())
        return cls(gain.astype(np.float32), offset.astype(np.float32), dead)


def mean_rate(recording: Recording) -> Image:
    """Spikes a frame of each pixel over a recording, [H, W], from the charge between its first and last spike."""
    frames = min(recording.frames, LONGEST_FRAMES)
    if frames < 200:
        raise CalibrationError(f"{recording.path} has {frames} frames: a calibration needs 200 or more, better 10,000")
    window = aligned_window(recording.read(0, frames), recording.sensor, 0, 0, frames)
    return np.where(window.valid, window.rate(fill=True), window.count / np.float32(frames)).astype(np.float32)


def around(image: Image, good: NDArray[np.bool_]) -> Image:
    """For each pixel the mean of the good ones in the smallest square about it that has one."""
    out = np.where(good, image, 0).astype(np.float32)
    missing = ~good
    weight = good.astype(np.float32)
    reach = 1
    while missing.any() and reach < max(image.shape):
        total, count = _square_sum(out * weight, reach), _square_sum(weight, reach)
        fill = missing & (count > 0.5)
        out[fill] = total[fill] / count[fill]
        missing &= ~fill
        reach *= 2
    return np.asarray(out, np.float32)


def _square_sum(image: Image, reach: int) -> Image:
    padded = np.pad(image.astype(np.float64), ((reach + 1, reach), (reach + 1, reach))).cumsum(0).cumsum(1)
    size = 2 * reach + 1
    out = padded[size:, size:] - padded[:-size, size:] - padded[size:, :-size] + padded[:-size, :-size]
    return np.asarray(out, np.float32)


def _typical(net: Image, sensor: Sensor) -> Image:
    """The median rate, per colour of a mosaic: the light's colour must not enter the gains."""
    if sensor.mosaic is None:
        return np.full_like(net, max(float(np.median(net)), 1e-9))
    channels = sensor.mosaic.channels(*net.shape)
    typical = np.array([max(float(np.median(net[channels == c])), 1e-9) for c in range(3)], np.float32)
    return np.asarray(typical[channels], np.float32)
