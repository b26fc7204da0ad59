"""How long a recording the disk has room for: one figure for the API, the page and the doctor."""

from collections.abc import Sequence
from dataclasses import dataclass

from spiked_driver.framing import USB_HEIGHT, USB_WIDTH
from spiked_driver.source_kind import RATE_HZ

from spiked.sensor import Sensor
from spiked_service.captures.captures import Captures
from spiked_service.store.folder import Space

USB_CAMERA = Sensor(USB_WIDTH, USB_HEIGHT, RATE_HZ)
"""What the forecast is about while no camera runs."""


@dataclass(frozen=True)
class DiskForecast:
    """Of the cameras that run, or of a USB camera if none does."""

    bytes_s: float
    """Bytes a second of all."""
    seconds: float
    """Recording that fits."""
    of: str
    """The cameras."""


def disk_forecast(space: Space, running: Sequence[Sensor] = ()) -> DiskForecast:
    """The forecast for sensors that record at the same time, at the rates that they state."""
    sensors = running or (USB_CAMERA,)
    bytes_s = sum(sensor.compact().frame_bytes * sensor.frame_rate_hz for sensor in sensors)
    of = " and ".join(f"{one.width}x{one.height} at {one.frame_rate_hz / 1e3:g} kHz" for one in sensors)
    return DiskForecast(bytes_s, space.free_bytes / bytes_s, of)


def running_sensors(captures: Captures) -> list[Sensor]:
    """Of the cameras whose frames are received or awaited."""
    rows = (one.row for one in captures.live())
    return [row.sensor for row in rows if row.sensor is not None and row.state.acquiring]
