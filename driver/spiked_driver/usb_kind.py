"""The USB3 camera as a kind of source: `usb0`, `usb:BUS-PORT` or `usb:SERIAL`."""

from typing import Literal

from pydantic import Field

from spiked.errors import SourceError
from spiked.ring import DeviceState
from spiked_driver.capabilities import USB_CAPABILITIES
from spiked_driver.ft60x import SessionMode
from spiked_driver.source_kind import Device, HardwareOptions, SourceKind, SourceSpec, Warn
from spiked_driver.transfers import MOST_REQUESTS
from spiked_driver.usb import UsbSource
from spiked_driver.usb_budget import TRANSFER_BYTES
from spiked_driver.usb_cameras import CameraChoice, UsbCamera, find_cameras
from spiked_driver.usb_connection import SILENCE_S, UsbOptions


class UsbCameraOptions(HardwareOptions):
    """Options of the USB3 camera."""

    hide_ms: float | None = Field(None, gt=0, le=10_000)
    """Milliseconds the host may be busy without a loss. Default: 250, or less if the kernel's limit is lower."""
    transfer_kib: int = Field(TRANSFER_BYTES >> 10, ge=16, le=16 << 10)
    """Size of a bulk transfer in KiB."""
    transfers: Literal["queued", "single"] = "queued"
    """`single`: one read at a time, for machines where queued reads do not work."""
    silence_s: float = Field(SILENCE_S, ge=0.01, le=3600)
    """Seconds without a byte after which the camera counts as lost."""
    session: Literal["auto", "request", "stream"] = "auto"
    """How the bridge is made to send: each read asked for, or in its stream mode. auto: whichever brings bytes."""
    requests: int = Field(MOST_REQUESTS, ge=1, le=1024)
    """Read requests that the bridge holds at a time, at most."""


def _open(spec: SourceSpec, options: UsbCameraOptions, warn: Warn | None) -> UsbSource:
    return UsbSource(
        CameraChoice.parse(spec.address),
        UsbOptions(
            rate_hz=options.rate,
            camera=options,
            buffer_s=None if options.hide_ms is None else options.hide_ms / 1e3,
            transfer_bytes=options.transfer_kib << 10,
            asynchronous=options.transfers == "queued",
            silence_s=options.silence_s,
            session=None if options.session == "auto" else SessionMode(options.session),
            most_requests=options.requests,
        ),
        warn,
    )


def _describe(spec: SourceSpec) -> Device:
    try:
        choice = CameraChoice.parse(spec.address)
        camera = choice.pick(find_cameras())
    except SourceError as error:
        return Device(spec.text, KIND.name, "a USB camera", reason=str(error), capabilities=USB_CAPABILITIES)
    if camera is not None:
        return _present(spec.text, camera)
    return Device(
        spec.text,
        KIND.name,
        "a USB camera that is not plugged in",
        DeviceState.ABSENT,
        f"there is no camera {choice}: plug it in",
        capabilities=USB_CAPABILITIES,
    )


def _find() -> list[Device]:
    return [_present(f"usb:{camera.port}", camera) for camera in find_cameras()]


def _present(source: str, camera: UsbCamera) -> Device:
    return Device(
        source,
        KIND.name,
        f"400x250 spike camera behind an {camera.chip}",
        reason=camera.speed_problem() or camera.permission_problem() or "",
        serial=camera.serial,
        port=camera.port,
        speed=camera.speed,
        firmware=camera.firmware,
        capabilities=USB_CAPABILITIES,
    )


KIND = SourceKind(
    name="usb",
    usage="usb0",
    summary="a USB3 spike camera, by number (usb0), port (usb:BUS-PORT) or serial number (usb:SERIAL)",
    options=UsbCameraOptions,
    open=_open,
    describe=_describe,
    find=_find,
    is_camera=True,
    numbered=True,
)
