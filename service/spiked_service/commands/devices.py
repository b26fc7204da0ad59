"""`spiked devices`: what can be captured from on this machine."""

from spiked_service.console import output
from spiked_service.devices import known_devices


def devices() -> None:
    """List the cameras and sources that `spiked serve --device` can be given."""
    for device in known_devices([]):
        output.print(f"{device.source:14s} {device.description}", markup=False)
