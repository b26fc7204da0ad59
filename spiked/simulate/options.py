"""What a simulated sensor gets wrong, as options: one definition for `sim:`, requests and the command line.

The equations are those of section E of the supplement of "3D Gaussian Splatting from Unposed Spike Streams" (CVPR
2026). Charge is counted in nominal thresholds, the charge of one spike.
"""

from typing import Self

from pydantic import BaseModel, ConfigDict, Field

from spiked.errors import ConfigurationError
from spiked.sensor import Response
from spiked.simulate.sensor import Lighting, SensorNoise, thermal_reset_noise

_REAL = SensorNoise()
_STEADY = Lighting()
_OF_A_THRESHOLD = ("electrons_a_spike", "temperature_k", "swing_v", "reset_noise", "threshold_jitter")
"""Options without a meaning for a single-photon camera, which has no charge and no threshold."""
_FIXED_THRESHOLD = ("capacitance_mismatch", "reset_bias")


class NoiseOptions(BaseModel):
    """Noise, defects and light of a simulated sensor; each may be left out."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    electrons_a_spike: float = Field(default=_REAL.electrons_a_spike, ge=1, le=1e12)
    """Photo-electrons of one spike; shot noise is normal with the variance of a Poisson law (Eq 13, 14)."""
    temperature_k: float = Field(default=300.0, ge=0, le=1000)
    """Absolute temperature in kelvin, of the thermal noise of a reset, sqrt(k T / C) (Eq 16); dark current is apart."""
    swing_v: float = Field(default=1.0, ge=0.01, le=100)
    """Voltage of the threshold in volts, Vp - Vref (Eq 15); with the electrons it gives the capacitance C of Eq 16."""
    reset_noise: float | None = Field(default=None, ge=0, le=1)
    """Standard deviation of the reset voltage as a share of the threshold, instead of what Eq 16 gives."""
    threshold_jitter: float = Field(default=_REAL.threshold_jitter, ge=0, le=1)
    """Noise of the comparator: standard deviation of the threshold at each spike, as a share of it."""
    dark: float = Field(default=_REAL.dark, ge=0, le=10)
    """Mean dark current in spikes a frame (Eq 17)."""
    dark_spread: float = Field(default=_REAL.dark_spread, ge=0, le=10)
    """Standard deviation of the dark current over the pixels, in spikes a frame (Eq 17)."""
    capacitance_mismatch: float = Field(default=_REAL.capacitance_mismatch, ge=0, le=0.5)
    """Standard deviation of the pixels' capacitance, as a share: fixed pattern of the threshold (Eq 18)."""
    reset_bias: float = Field(default=_REAL.reset_bias, ge=0, le=0.5)
    """Half width of the uniform distribution of the pixels' reset voltage, as a share of the swing (after Eq 18)."""
    hot_share: float = Field(default=_REAL.hot_share, ge=0, le=1)
    """Share of the pixels that are hot."""
    hot_rate: float = Field(default=_REAL.hot_rate, ge=0, le=10)
    """Extra dark current of a hot pixel, in spikes a frame."""
    dead_share: float = Field(default=_REAL.dead_share, ge=0, le=1)
    """Share of the pixels that never fire."""
    flicker: float = Field(default=_STEADY.flicker, ge=0, lt=1)
    """Depth of the light's flicker: amplitude as a share of the mean."""
    flicker_hz: float = Field(default=_STEADY.flicker_hz, gt=0, le=1e6)
    """Frequency of the flicker in Hz; lamps have twice that of the mains."""

    def noise(self) -> SensorNoise:
        """The same for the sensor model."""
        thermal = thermal_reset_noise(self.electrons_a_spike, self.swing_v, self.temperature_k)
        same = NoiseOptions.model_fields.keys() & SensorNoise.__dataclass_fields__.keys() - {"reset_noise"}
        return SensorNoise(
            **{name: getattr(self, name) for name in same},
            reset_noise=thermal if self.reset_noise is None else self.reset_noise,
        )

    def lighting(self) -> Lighting:
        """The same for the sensor model."""
        return Lighting(self.flicker, self.flicker_hz)

    def checked(self, response: Response) -> Self:
        """Itself. Raises ConfigurationError if something is stated that sensors of this response do not have."""
        absent = (*_OF_A_THRESHOLD, *_FIXED_THRESHOLD)
        stated = [name for name in absent if getattr(self, name) != NoiseOptions.model_fields[name].default]
        if response is Response.BERNOULLI and stated:
            raise ConfigurationError(
                f"a single-photon camera (response bernoulli) has no threshold: leave out {', '.join(stated)}"
            )
        return self
