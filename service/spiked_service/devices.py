"""The cameras and sources that this machine has, and how they stand while no capture uses them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from spiked_driver.capabilities import PCIE_CAPABILITIES, USB_CAPABILITIES, Capability
from spiked_driver.spec import is_camera
from spiked_driver.usb_cameras import CameraChoice, UsbCamera, find_cameras

from spiked.errors import SourceError
from spiked.ring import DeviceState


@dataclass(frozen=True)
class Device:
    """Something that a capture can be started from."""

    source: str
    """What to give as `source`: usb0, sim: or replay:FILE, with options after a question mark."""
    kind: str
    description: str
    state: DeviceState = DeviceState.IDLE
    """As it is without a capture: absent or idle."""
    reason: str = ""
    """Why it is absent, or what keeps it from being used."""
    serial: str | None = None
    port: str | None = None
    speed: str | None = None
    firmware: str | None = None
    capabilities: Mapping[str, Capability] = field(default_factory=dict)


def known_devices(configured: list[str]) -> list[Device]:
    """The sources named to the daemon, the cameras that are plugged in, and what is always there."""
    cameras = find_cameras()
    named = [_configured(source, cameras) for source in configured]
    taken = {device.port for device in named if device.port}
    plugged = [_usb(f"usb:{camera.port}", camera) for camera in cameras if camera.port not in taken]
    built_in = [
        Device("sim:", "sim", "simulated hand-held camera in a built-in room; options seed, seconds, width, height"),
        Device("replay:FILE", "replay", "a recording; options pace, repeat, range"),
    ]
    return named + plugged + [device for device in built_in if device.source not in configured]


def _configured(source: str, cameras: list[UsbCamera]) -> Device:
    kind = source.partition(":")[0]
    if kind == "pcie":
        return Device(source, kind, "raw stream of a PCIe camera", capabilities=PCIE_CAPABILITIES)
    if not is_camera(source):
        return Device(source, kind, "given with --device")
    try:
        choice = CameraChoice.parse(source.partition("?")[0])
        camera = choice.pick(cameras)
    except SourceError as error:
        return Device(source, "usb", "a USB camera", reason=str(error), capabilities=USB_CAPABILITIES)
    if camera is not None:
        return _usb(source, camera)
    return Device(
        source,
        "usb",
        "a USB camera, waited for",
        DeviceState.ABSENT,
        f"there is no camera {choice}: plug it in",
        capabilities=USB_CAPABILITIES,
    )


def _usb(source: str, camera: UsbCamera) -> Device:
    return Device(
        source,
        "usb",
        f"400x250 spike camera behind an {camera.chip}",
        reason=camera.speed_problem() or camera.permission_problem() or "",
        serial=camera.serial,
        port=camera.port,
        speed=camera.speed,
        firmware=camera.firmware,
        capabilities=USB_CAPABILITIES,
    )
