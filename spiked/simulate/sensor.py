"""An integrate-and-fire sensor with the noise of a real one: radiance images in, packed binary frames out.

The model is that of section E of the supplement of "3D Gaussian Splatting from Unposed Spike Streams" (CVPR 2026).
A single-photon camera (`Response.BERNOULLI`) has no charge to keep: its pixels fire with p = 1 - exp(-flux).
Charge is counted in nominal thresholds, so that one unit of charge is one spike. Each frame a pixel receives
`q = gain * radiance + dark` plus shot noise of variance `q / electrons_a_spike`; when its charge reaches its
threshold it fires and the threshold is subtracted, so no charge is lost between frames. A pixel that crosses its
threshold several times in one frame fires once: the latch holds one bit, and the charge of the further crossings is
lost.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import spiked.native._simulate as _simulate
from spiked.errors import ConfigurationError
from spiked.sensor import BitOrder, Image, Layout, Response, Sensor

_BOLTZMANN_J_PER_K = 1.380649e-23
"""Exact by definition of the SI."""
_ELEMENTARY_CHARGE_C = 1.602176634e-19
"""Exact by definition of the SI."""


def thermal_reset_noise(electrons_a_spike: float, swing_v: float = 1.0, temperature_k: float = 300.0) -> float:
    """The kTC noise of a reset as a share of the threshold: `sqrt(k T C) / (C swing)`, C = electrons * e / swing."""
    capacitance_f = electrons_a_spike * _ELEMENTARY_CHARGE_C / swing_v
    return float(np.sqrt(_BOLTZMANN_J_PER_K * temperature_k / capacitance_f) / swing_v)


@dataclass(frozen=True)
class SensorNoise:
    """Every imperfection of the sensor. The defaults sum to 1 % threshold jitter and 2 % fixed-pattern threshold."""

    electrons_a_spike: float = 4000.0
    """Photo-electrons that make up one nominal threshold; the shot noise of one spike is 1 / sqrt of it."""
    reset_noise: float = thermal_reset_noise(4000.0)
    """Thermal (kTC) noise of a reset: standard deviation as a share of the threshold, drawn at each spike."""
    threshold_jitter: float = 0.00967
    """Comparator noise: standard deviation as a share of the threshold, drawn at each spike."""
    dark: float = 0.002
    """Mean dark current in spikes a frame."""
    dark_spread: float = 0.0002
    """Standard deviation of the dark current over the pixels, in spikes a frame; no pixel goes below zero."""
    capacitance_mismatch: float = 0.016
    """Standard deviation of the pixels' capacitance, as a share."""
    reset_bias: float = 0.0208
    """Half width of the uniform distribution of the pixels' reset voltage, as a share of the swing."""
    hot_share: float = 0.0
    """Share of the pixels whose dark current is `hot_rate` more."""
    hot_rate: float = 0.2
    """Extra dark current of a hot pixel in spikes a frame."""
    dead_share: float = 0.0
    """Share of the pixels that never fire."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"sensor noise {name} = {value} must be a number of at least 0")
        if self.electrons_a_spike < 1 or self.hot_share > 1 or self.dead_share > 1:
            raise ConfigurationError("sensor noise needs at least 1 electron a spike and shares of at most 1")

    @classmethod
    def none(cls) -> "SensorNoise":
        """A perfect integrator: the only thing left is that spikes are read once a frame."""
        return cls(1e12, 0, 0, 0, 0, 0, 0)

    @property
    def spike_jitter(self) -> float:
        """Both draws of an interval in one: of the reset that begins it and of the comparison that ends it."""
        return float(np.hypot(self.reset_noise, self.threshold_jitter))


@dataclass(frozen=True)
class GainStep:
    """The whole scene's brightness is multiplied by `gain` from `frame` on, as when a lamp is switched."""

    frame: int
    gain: float


@dataclass(frozen=True)
class Lighting:
    """How the brightness of the whole scene changes over time."""

    flicker: float = 0.0
    """Amplitude of the flicker as a share of the mean, below 1."""
    flicker_hz: float = 100.0
    """Its frequency: twice the mains'."""
    steps: tuple[GainStep, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.flicker < 1 or self.flicker_hz <= 0 or any(step.gain < 0 for step in self.steps):
            raise ConfigurationError(
                "lighting needs a flicker from 0 up to (not including) 1, a positive frequency and no negative gain"
            )

    def gains(self, frames: NDArray[np.int64], frame_rate_hz: float) -> Image:
        """The mean gain over each frame, float32 [n]."""
        gains = np.ones(len(frames))
        for step in sorted(self.steps, key=lambda step: step.frame):
            gains[frames >= step.frame] = step.gain
        turn = 2 * np.pi * self.flicker_hz / frame_rate_hz
        # The integral of the sine over [k, k + 1).
        gains *= 1 + self.flicker * np.sin(turn * (frames + 0.5)) * np.sinc(turn / (2 * np.pi))
        return gains.astype(np.float32)


@dataclass(frozen=True)
class PixelMaps:
    """What differs from pixel to pixel and stays, upright float32 [height, width] each."""

    gain: Image
    """Share of the radiance that becomes charge (vignetting, dust)."""
    dark: Image
    """Dark current in spikes a frame."""

    @classmethod
    def read_calibration(cls, path: Path | str) -> "PixelMaps":
        """Maps from a camera's calibration (`.npz` with `Nl` and `Nd`, upright).

        `Nl` is the light response, used relative to its median; `Nd` the interval in the dark in arbitrary units, whose
        inverse is used with a median of 0.002 spikes a frame. Both are clipped at 0.1 and 99.9 %: a ratio of nearly
        nothing says no more than "dead" or "hot".
        """
        with np.load(path) as table:
            if not {"Nl", "Nd"} <= set(table.files):
                raise ConfigurationError(f"{path} has no Nl and Nd; expected a calibration of both")
            light, interval = (_clipped(table[name]) for name in ("Nl", "Nd"))
        gain = light / np.median(light)
        dark = 0.002 * np.median(interval) / interval
        return cls(gain.astype(np.float32), dark.astype(np.float32))


def _clipped(values: NDArray[np.float32]) -> NDArray[np.float64]:
    low, high = np.percentile(values, [0.1, 99.9])
    return np.clip(values.astype(np.float64), low, high)


@dataclass
class SpikeSensor:
    """A sensor at work: holds each pixel's charge from call to call. The same seed gives the same bits on every
    machine, at any number of threads and in calls of any size."""

    sensor: Sensor
    seed: int = 0
    noise: SensorNoise = field(default_factory=SensorNoise)
    lighting: Lighting = field(default_factory=Lighting)
    maps: PixelMaps | None = None
    """A measured pattern; it replaces the drawn dark current and multiplies the drawn gain."""
    threads: int = 1
    next_frame: int = field(default=0, init=False)
    """Absolute index of the next frame to be exposed."""

    def __post_init__(self) -> None:
        shape = (self.sensor.height, self.sensor.width)
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, 0x5E5]))
        noise = self.noise
        capacitance = 1 + noise.capacitance_mismatch * rng.standard_normal(shape)
        bias = 1 + noise.reset_bias * rng.uniform(-1, 1, shape)
        dark = np.maximum(noise.dark + noise.dark_spread * rng.standard_normal(shape), 0)
        gain = np.ones(shape)
        if self.maps is not None:
            if self.maps.gain.shape != shape or self.maps.dark.shape != shape:
                raise ConfigurationError(
                    f"calibration maps of {self.maps.gain.shape} do not fit a sensor of {shape} (height, width)"
                )
            gain, dark = self.maps.gain.astype(np.float64), self.maps.dark.astype(np.float64)
        dark = dark + noise.hot_rate * (rng.random(shape) < noise.hot_share)
        alive = rng.random(shape) >= noise.dead_share
        self._gain = np.ascontiguousarray(gain * alive, np.float32)
        self._dark = np.ascontiguousarray(dark * alive, np.float32)
        self._threshold = np.maximum(capacitance * bias, 0.1).astype(np.float32)
        self._noise_factor = np.full(shape, 1 / noise.electrons_a_spike, np.float32)
        # Found at a random moment, a pixel has received a uniform part of the charge of its next spike.
        self._missing = (self._threshold * rng.uniform(2**-20, 1, shape)).astype(np.float32)
        # A dead pixel receives nothing, and a missing charge above zero then never falls to zero.
        self._key = int(rng.integers(0, 2**63))

    @property
    def threshold(self) -> Image:
        """Charge of a spike of each pixel in nominal thresholds, upright float32 [height, width]."""
        return self._threshold

    @property
    def dark(self) -> Image:
        """Dark current of each pixel in spikes a frame, upright float32 [height, width]."""
        return self._dark

    @property
    def gain(self) -> Image:
        """Share of the radiance that becomes charge, upright float32 [height, width]."""
        return self._gain

    def expose(
        self, first: Image, last: Image, weights: Image, out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Expose frames whose radiance runs linearly between two images, and return them as stored.

        first, last: upright float32 [height, width] in expected spikes a frame; on a mosaic, what each site sees.
        weights: of `last` in the mean radiance of each frame, float32 [n]; for a constant image give zeros.
        out: where to put them, uint8 [n, frame_bytes]. Returns it, or a new array.
        """
        sensor, count = self.sensor, len(weights)
        if out is None:
            out = np.empty((count, sensor.frame_bytes), np.uint8)
        frames = np.arange(self.next_frame, self.next_frame + count, dtype=np.int64)
        if sensor.response is Response.BERNOULLI:
            self._count_photons(first, last, weights, frames, out)
            return out
        _simulate.expose(
            first=first,
            last=last,
            weights=np.ascontiguousarray(weights, np.float32),
            gains=self.lighting.gains(frames, sensor.frame_rate_hz),
            first_frame=self.next_frame,
            gain=self._gain,
            dark=self._dark,
            threshold=self._threshold,
            noise_factor=self._noise_factor,
            jitter=self.noise.spike_jitter,
            seed=self._key,
            missing=self._missing,
            out=out,
            stride=sensor.row_stride,
            flipped=sensor.flipped,
            msb_first=sensor.bit_order is BitOrder.MSB,
            row_tagged=sensor.layout is Layout.ROW_TAGGED,
            threads=self.threads,
        )
        self.next_frame += count
        return out

    def _count_photons(
        self, first: Image, last: Image, weights: Image, frames: NDArray[np.int64], out: NDArray[np.uint8]
    ) -> None:
        """As `expose`, for a pixel that fires with p = 1 - exp(-flux)."""
        sensor, gains = self.sensor, self.lighting.gains(frames, self.sensor.frame_rate_hz)
        for number, weight, gain, stored in zip(frames.tolist(), weights, gains, out, strict=True):
            flux = self._gain * gain * (first + weight * (last - first)) + self._dark
            drawn = np.random.default_rng([self._key, number]).random(flux.shape, np.float32)
            fired = drawn < -np.expm1(-flux)
            rows = fired[::-1] if sensor.flipped else fired
            stored[:] = np.packbits(rows, axis=1, bitorder="little").ravel()
        self.next_frame += len(frames)
