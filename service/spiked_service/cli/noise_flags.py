"""Flags of the simulated sensor's noise; names, bounds and help are those of `NoiseOptions`."""

from dataclasses import dataclass
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from spiked.errors import ConfigurationError
from spiked.simulate import NoiseOptions

DEFAULT = NoiseOptions()
"""The noise of a real sensor."""


def _flag(name: str, panel: str) -> Any:
    """The flag of a field, with its bounds."""
    field = NoiseOptions.model_fields[name]
    bounds = {kind: getattr(part, kind) for part in field.metadata for kind in ("ge", "le") if hasattr(part, kind)}
    return typer.Option(help=field.description, rich_help_panel=panel, min=bounds.get("ge"), max=bounds.get("le"))


_NOISE, _DEFECTS, _LIGHT = "Noise of the sensor", "Defects of the sensor", "Light"
"""Panels of the help."""

ElectronsASpike = Annotated[float, _flag("electrons_a_spike", _NOISE)]
TemperatureK = Annotated[float, _flag("temperature_k", _NOISE)]
SwingV = Annotated[float, _flag("swing_v", _NOISE)]
ResetNoise = Annotated[float | None, _flag("reset_noise", _NOISE)]
ThresholdJitter = Annotated[float, _flag("threshold_jitter", _NOISE)]
Dark = Annotated[float, _flag("dark", _NOISE)]
DarkSpread = Annotated[float, _flag("dark_spread", _NOISE)]
CapacitanceMismatch = Annotated[float, _flag("capacitance_mismatch", _NOISE)]
ResetBias = Annotated[float, _flag("reset_bias", _NOISE)]
HotShare = Annotated[float, _flag("hot_share", _DEFECTS)]
HotRate = Annotated[float, _flag("hot_rate", _DEFECTS)]
DeadShare = Annotated[float, _flag("dead_share", _DEFECTS)]
Flicker = Annotated[float, _flag("flicker", _LIGHT)]
FlickerHz = Annotated[float, _flag("flicker_hz", _LIGHT)]


@dataclass(frozen=True)
class NoiseFlags:
    """One flag for each field of `NoiseOptions`."""

    electrons_a_spike: ElectronsASpike = DEFAULT.electrons_a_spike
    temperature_k: TemperatureK = DEFAULT.temperature_k
    swing_v: SwingV = DEFAULT.swing_v
    reset_noise: ResetNoise = DEFAULT.reset_noise
    threshold_jitter: ThresholdJitter = DEFAULT.threshold_jitter
    dark: Dark = DEFAULT.dark
    dark_spread: DarkSpread = DEFAULT.dark_spread
    capacitance_mismatch: CapacitanceMismatch = DEFAULT.capacitance_mismatch
    reset_bias: ResetBias = DEFAULT.reset_bias
    hot_share: HotShare = DEFAULT.hot_share
    hot_rate: HotRate = DEFAULT.hot_rate
    dead_share: DeadShare = DEFAULT.dead_share
    flicker: Flicker = DEFAULT.flicker
    flicker_hz: FlickerHz = DEFAULT.flicker_hz

    def options(self) -> NoiseOptions:
        """Raises ConfigurationError."""
        try:
            return NoiseOptions.model_validate(vars(self))
        except ValidationError as error:
            first = error.errors()[0]
            flag = str(first["loc"][0]).replace("_", "-")
            problem = first["msg"].replace("Input should be", "it must be")
            raise ConfigurationError(f"--{flag} {first['input']}: {problem}") from error
