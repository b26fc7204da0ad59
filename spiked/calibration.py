"""A camera's per-pixel gain, dark rate and defects, from a recording in the dark and one of an even light."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.errors import CalibrationError
from spiked.numpy_files import UNREADABLE, read_npz
from spiked.recording import Recording
from spiked.sensor import Image, Mosaic, Response, Sensor

__all__ = ["Calibration", "CalibrationSummary", "mean_rate"]

LEAST_FRAMES, LONGEST_FRAMES = 200, 60_000
"""Frames that a recording needs, and of which no more are used."""
READ_FRAMES = 1024
"""Frames that are counted at once."""
HOT_SHARE = 0.2
"""A pixel is hot if its dark rate exceeds this share of the even light's median rate."""
HOT_RATE = 0.04
"""The same without an even light, spikes a frame: the share of a light at which pixels fire every fifth frame."""
DARK, ALIKE = 0.02, 0.5
"""Median rate, spikes a frame, up to which a recording counts as dark by itself; above it, the correlation of pixels
that are two apart has to be less than this: dark currents of pixels are independent, light is not."""
BRIGHTEST = {Response.INTEGRATE_AND_FIRE: 0.95, Response.BERNOULLI: 3.0}
"""Largest median rate of an even light: above it pixels fire in nearly every frame."""
GAIN_LIMITS = (0.2, 4.0)
"""Pixels whose gain relative to the median lies outside are dead, or stuck."""

_MOST_BYTES = 1 << 28
"""Of an array in a file: float32 of 8192x8192 pixels."""


@dataclass(frozen=True)
class CalibrationSummary:
    """Figures of a calibration."""

    gain_spread: float
    """Standard deviation of the logarithm of good pixels' gains: 0.01 is 1 %."""
    dark_rate: float
    """Median over the pixels, spikes a frame."""
    useless: int
    """Pixels to leave out: dead, stuck or hot."""
    pixels: int
    """Of the sensor."""

    def __str__(self) -> str:
        """As a sentence without its full stop."""
        return (
            f"gains differ by {100 * self.gain_spread:.1f} % (standard deviation), dark rate {self.dark_rate:.4f} "
            f"spikes a frame, {self.useless} of {self.pixels} pixels dead or hot"
        )


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

    def apply(self, rate: Image, deviation: Image, mosaic: Mosaic | None = None) -> tuple[Image, Image]:
        """Light and its deviation from a measured rate [H, W].

        Dead pixels take the light of their neighbours, of a mosaic those of their colour, and are uncertain.
        """
        light = np.maximum(rate - self.dark, 0) / self.gain
        spread = deviation / self.gain
        if self.dead.any():
            light = around(light, ~self.dead, mosaic)
            spread = np.where(self.dead, np.float32(1e3), spread)
        return light.astype(np.float32), spread.astype(np.float32)

    def write(self, path: Path) -> None:
        """As a NumPy archive (.npz) with `gain`, `dark` (float32) and `dead` (bool).

        After an error the file before is whole. Raises CalibrationError.
        """
        part = path.with_name(f".{path.name}.part")
        try:
            try:
                with part.open("wb") as file:
                    np.savez_compressed(file, gain=self.gain, dark=self.dark, dead=self.dead)
                    file.flush()
                    os.fsync(file.fileno())
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
        except OSError as error:
            raise CalibrationError(f"cannot write {path}: {error.strerror}; choose another place") from error

    @classmethod
    def read(cls, path: Path) -> "Calibration":
        """Raises CalibrationError if the file is missing or not a calibration."""
        try:
            gain, dark, dead = read_npz(path, ("gain", "dark", "dead"), _MOST_BYTES)
            if any(part.dtype.kind not in "bfiu" for part in (gain, dark, dead)):
                raise ValueError("arrays of no real numbers")
            return cls(gain.astype(np.float32), dark.astype(np.float32), dead.astype(bool))
        except OSError as error:
            raise CalibrationError(f"cannot read the calibration {path}: {error.strerror or error}") from error
        except UNREADABLE as error:
            raise CalibrationError(
                f"{path} is not a calibration: it must be an .npz of `spiked calibrate` with gain, dark and dead"
            ) from error

    @classmethod
    def measure(
        cls, flat: Recording | None, dark: Recording | None, before: "Calibration | None" = None
    ) -> "Calibration":
        """From a recording of an even light, one with the lens covered, or both. Raises CalibrationError.

        What a recording that is not given would say is taken from `before`: without it gains are 1, dark rates 0.
        """
        if flat is None and dark is None:
            raise CalibrationError("a calibration needs a recording of an even light, one in the dark, or both")
        if flat is not None and dark is not None and _size(dark) != _size(flat):
            raise CalibrationError(
                f"{dark.path} is of {dark.sensor.width}x{dark.sensor.height} pixels and {flat.path} of "
                f"{flat.sensor.width}x{flat.sensor.height}: they must be of one camera"
            )
        for recording in (flat, dark):
            if before is not None and recording is not None:
                before.check(recording.sensor)
        light = None if flat is None else mean_rate(flat)
        if dark is not None:
            offset = _dark_rate(dark, light)
        elif before is not None:
            offset = before.dark
        else:
            offset = np.zeros_like(light) if light is not None else np.empty(0, np.float32)
        if flat is not None and light is not None:
            return cls._of_light(flat, light, offset)
        hot = offset > HOT_RATE
        if before is None:
            return cls(np.ones_like(offset), offset, hot)
        return cls(before.gain, offset, before.dead | hot)

    @classmethod
    def _of_light(cls, flat: Recording, light: Image, offset: Image) -> "Calibration":
        """From the rates [H, W] in an even light and in the dark."""
        if float(np.median(light)) < 0.005:
            raise CalibrationError(f"{flat.path} is too dark for a calibration: its median rate is below 0.005")
        if float(np.median(light)) > BRIGHTEST[flat.sensor.response]:
            raise CalibrationError(f"{flat.path} is saturated: use less light, pixels should fire every 2 to 20 frames")
        net = light - offset
        gain = net / _typical(net, flat.sensor)
        dead = (gain < GAIN_LIMITS[0]) | (gain > GAIN_LIMITS[1]) | (offset > HOT_SHARE * float(np.median(light)))
        if 2 * int(dead.sum()) > dead.size:
            raise CalibrationError(
                f"more than half of the pixels would be dead or hot by {flat.path}: use light that is even and several "
                "times as bright as the dark current, and recordings of one camera"
            )
        gain = np.where(dead, 1, gain)
        gain[~dead] /= np.exp(np.log(gain[~dead]).mean())
        return cls(gain.astype(np.float32), offset.astype(np.float32), dead)

    def summary(self) -> CalibrationSummary:
        """Its figures."""
        good = ~self.dead
        spread = float(np.std(np.log(self.gain[good]))) if good.any() else 0.0
        return CalibrationSummary(spread, float(np.median(self.dark)), int(self.dead.sum()), self.dead.size)


def mean_rate(recording: Recording) -> Image:
    """Light of each pixel over a recording, [H, W]: spikes a frame, or photons a frame of a single-photon camera.

    Spikes are counted between a pixel's first and last one, so that the rate has no error of a half spike.
    """
    frames, sensor = min(recording.frames, LONGEST_FRAMES), recording.sensor
    if frames < LEAST_FRAMES:
        raise CalibrationError(
            f"{recording.path} has {frames} frames: a calibration needs {LEAST_FRAMES} or more, better 10,000"
        )
    count, first, last = (np.zeros((sensor.height, sensor.width), np.int32) for _ in range(3))
    for begin in range(0, frames, READ_FRAMES):
        length = min(READ_FRAMES, frames - begin)
        window = aligned_window(recording.read(begin, length), sensor, begin, begin, begin + length)
        fired = window.count > 0
        np.copyto(first, window.start_offset.astype(np.int32) + begin, where=fired & (count == 0))
        np.copyto(last, window.stop_offset.astype(np.int32) + begin, where=fired)
        count += window.count
    if sensor.response is Response.BERNOULLI:
        return np.asarray(-np.log((frames - count + 0.5) / (frames + 0.5)), np.float32)
    rate = np.asarray(count / frames, np.float32)
    np.divide(count - 1, last - first, out=rate, where=count > 1, dtype=np.float32)
    return rate


def _size(recording: Recording) -> tuple[int, int]:
    return recording.sensor.width, recording.sensor.height


def _dark_rate(dark: Recording, light: Image | None) -> Image:
    """Rates [H, W] with the lens covered. Raises CalibrationError if it was not."""
    rate = mean_rate(dark)
    typical = float(np.median(rate))
    if light is None:
        if typical > DARK and _likeness(rate) > ALIKE:
            raise CalibrationError(
                f"{dark.path} is not dark: pixels fire {typical:.3f} times a frame, and their neighbours do alike; "
                "cover the lens"
            )
    elif typical > 0.5 * float(np.median(light)):
        raise CalibrationError(f"{dark.path} is not dark: it is more than half as bright as the even light")
    return rate


def _likeness(rate: Image) -> float:
    """Correlation of pixels that are two apart, which have one colour on a mosaic; outliers are clipped."""
    low, high = np.percentile(rate, [5, 95])
    clipped = np.clip(rate, low, high)
    if float(np.std(clipped)) == 0 or min(rate.shape) < 4:
        return 0.0
    pairs = ((clipped[:, 2:], clipped[:, :-2]), (clipped[2:], clipped[:-2]))
    return float(np.mean([np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in pairs]))


def around(image: Image, good: NDArray[np.bool_], mosaic: Mosaic | None = None) -> Image:
    """The image, and at pixels that are not good the mean of the good ones in the smallest square that has one.

    Of a mosaic they are those of the same colour.
    """
    if mosaic is None:
        return _around(image, good)
    out, channels = image.astype(np.float32), mosaic.channels(*image.shape)
    for channel in range(3):
        missing = (channels == channel) & ~good
        out[missing] = _around(image, good & (channels == channel))[missing]
    return out


def _around(image: Image, good: NDArray[np.bool_]) -> Image:
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
