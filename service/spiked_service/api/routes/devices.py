"""Devices: their state, and arming them for pre-trigger captures."""

import threading
from dataclasses import asdict
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any

import fastapi
from fastapi import APIRouter, Request, Response
from fastapi.routing import APIRoute
from spiked_driver.source_kind import Device

from spiked.calibration import Calibration
from spiked.errors import SpikedError
from spiked.profile import CameraProfile
from spiked.recording import Recording
from spiked.ring import DeviceState
from spiked_service.api import files
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import ConflictError, problems
from spiked_service.api.routes.parameters import BINARY, NOT_MODIFIED
from spiked_service.api.routes.recordings import closed_recording
from spiked_service.api.schemas.captures import (
    ArmRequest,
    CalibratedOut,
    CalibrationOut,
    CalibrationRequest,
    CapabilityOut,
    CountersOut,
    DeviceOut,
    DevicesOut,
    ProfileModel,
    ProfileOut,
)
from spiked_service.api.sources import Sources
from spiked_service.captures.camera_profiles import CameraProfiles, of_another_camera
from spiked_service.captures.captures import Captures
from spiked_service.captures.sources import device_of, unpaced
from spiked_service.events.bus import Bus, Topic
from spiked_service.events.logging import logger
from spiked_service.results.calibration_picture import CalibrationPicture, calibration_picture
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.folder import DataFolder

DeviceId = Annotated[str, fastapi.Path(description="As `GET devices` names it, percent-encoded.", max_length=4096)]

_LOOK_S = 2.0
"""Interval at which devices are checked, seconds."""
_log = logger("spiked.devices")


_CALIBRATION: dict[int | str, dict[str, Any]] = {
    200: {"description": "The picture.", "content": {"image/png": BINARY}},
    **NOT_MODIFIED,
    **problems(404),
}


def device_routes(captures: Captures, sources: Sources, folder: DataFolder, route_class: type[APIRoute]) -> APIRouter:
    """Routes below `devices`."""
    router = APIRouter(prefix="/devices", tags=["devices"], route_class=route_class)

    @router.get("", responses=problems())
    def list_devices() -> DevicesOut:
        """Devices that captures can be started from."""
        return DevicesOut(items=[shown(captures, device) for device in sources.devices()])

    # Ids may contain slashes (replay:folder/file.dat), so the longer paths come first.
    @router.post("/{device_id:device}:arm", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def arm_device(device_id: DeviceId, body: ArmRequest, idempotency_key: IdempotencyKey = None) -> DeviceOut:
        """Run the device without recording, so that a capture can start up to `pretrigger_s` before its request.

        This takes a moment; captures are taken from when its state is armed.
        """
        device = _find(sources, device_id)
        captures.arm(unpaced(device.source), body.pretrigger_s)
        return shown(captures, device)

    @router.post("/{device_id:device}:disarm", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def disarm_device(device_id: DeviceId, idempotency_key: IdempotencyKey = None) -> DeviceOut:
        """Stop an armed device. Does nothing if it is not armed."""
        device = _find(sources, device_id)
        captures.disarm(unpaced(device.source))
        return shown(captures, device)

    _add_profile_routes(router, sources, captures, folder, CameraProfiles(folder.profiles))

    @router.get("/{device_id:device}", responses=problems(404))
    def get_device(device_id: DeviceId) -> DeviceOut:
        """State, counters and capabilities of a device."""
        return shown(captures, _find(sources, device_id))

    return router


def _add_profile_routes(
    router: APIRouter, sources: Sources, captures: Captures, folder: DataFolder, profiles: CameraProfiles
) -> None:
    """Routes that read, write, measure and remove the profile of a device."""

    def tidy() -> None:
        # Captures and armed devices have read a profile, and may read its calibration later.
        if not captures.live() and not captures.armed():
            profiles.remove_unused_calibrations(device.source for device in sources.devices())

    @router.get("/{device_id:device}/profile", responses=problems(404))
    def get_device_profile(device_id: DeviceId) -> ProfileOut:
        """What captures of the device take from its profile."""
        return _profile_out(profiles.file(_find(sources, device_id)))

    @router.put("/{device_id:device}/profile", responses=problems(404, 409, 507))
    def set_device_profile(device_id: DeviceId, body: ProfileModel) -> ProfileOut:
        """Replace the profile of the device; captures that run keep theirs. It is checked and survives a restart.

        It is kept by the camera's serial number, or by the device's id if the number is missing or not its own.
        """
        device = _find(sources, device_id)
        if body.serial is not None and device.serial is not None and body.serial != device.serial:
            raise ConflictError(f"the profile is of camera {body.serial}, and {device_id} is camera {device.serial}")
        if body.calibration is not None:
            sources.check_file(str(profiles.folder / body.calibration), profiles.folder)
        written = profiles.replace(device, body)
        tidy()
        return ProfileOut(file=written.name, profile=body)

    @router.delete("/{device_id:device}/profile", status_code=HTTPStatus.NO_CONTENT, responses=problems(404))
    def remove_device_profile(device_id: DeviceId) -> None:
        """Remove the profile of the device."""
        profiles.remove(_find(sources, device_id))
        tidy()

    @router.post("/{device_id:device}/profile:calibrate", responses=problems(404, 409, 507))
    def calibrate_device(
        device_id: DeviceId, body: CalibrationRequest, idempotency_key: IdempotencyKey = None
    ) -> CalibratedOut:
        """Measure gains, dark rates and defects from recordings, and store them with the profile of the device.

        Captures of the device are corrected by them from then on. What the recordings do not say stays as it was.
        """
        device = _find(sources, device_id)
        flat, dark = (
            None if one is None else _recording_by(device, one, captures, folder) for one in (body.flat, body.dark)
        )
        file, measured = profiles.calibrate(device, flat, dark)
        tidy()
        shown = CalibrationOut(**asdict(measured.summary()))
        return CalibratedOut(**_profile_out(file).model_dump(), measured=shown)

    @router.get("/{device_id:device}/profile/calibration", responses=_CALIBRATION, response_class=Response)
    def get_device_calibration(
        device_id: DeviceId, request: Request, kind: CalibrationPicture = CalibrationPicture.DARK
    ) -> Response:
        """A picture of what is known of each pixel, as PNG."""
        path = profiles.calibration(_find(sources, device_id))
        if path is None:
            raise UnknownIdError(f"device {device_id} has no calibration; POST profile:calibrate makes one")
        tag = files.etag(kind, files.stamp(path))
        if files.unchanged(request, tag):
            return files.not_modified(tag)
        return files.content(request, calibration_picture(Calibration.read(path), kind), "image/png", tag)


def _profile_out(path: Path) -> ProfileOut:
    return ProfileOut(file=path.name, profile=ProfileModel(**CameraProfile.read(path).model_dump()))


def _recording_by(device: Device, capture_id: str, captures: Captures, folder: DataFolder) -> Recording:
    """The recording of a capture. Raises ConflictError while it is written, and if another camera made it."""
    recording = closed_recording(captures, folder, capture_id)
    other = of_another_camera(captures.get(capture_id).row, recording, device)
    if other is not None:
        raise ConflictError(
            f"capture {capture_id} is of {other}, not of {device.source}: calibrate with a capture of this camera"
        )
    return recording


def _find(sources: Sources, device_id: str) -> Device:
    for device in sources.devices():
        if device.source == device_id:
            return device
    raise UnknownIdError(f"there is no device {device_id}; GET devices lists them")


def shown(captures: Captures, device: Device) -> DeviceOut:
    """The current state of a device."""
    name = device_of(unpaced(device.source))
    live = next((one for one in captures.live() if device_of(one.row.source) == name), None)
    standby = captures.armed().get(name)
    state, reason, counters = device.state, device.reason, None
    warnings: tuple[str, ...] = ()
    if live is not None:
        counters, warnings = live.counters, live.row.warnings
    elif standby is not None:
        counters, warnings = standby.counters(), standby.warnings
        state, reason = (device.state, device.reason) if counters is None else (DeviceState.ARMED, "")
    if counters is not None and (live is not None or counters.device is not DeviceState.STREAMING):
        state, reason = counters.device, counters.device_reason
    if standby is not None and state is not DeviceState.ARMED and not reason:
        reason = "being armed: a capture can start when it is armed"
    return DeviceOut(
        id=device.source,
        kind=device.kind,
        source=device.source,
        description=device.description,
        state=state,
        reason=reason,
        warnings=list(warnings),
        serial=device.serial,
        port=device.port,
        speed=device.speed,
        firmware=device.firmware,
        capabilities={name: CapabilityOut(**asdict(one)) for name, one in device.capabilities.items()},
        counters=CountersOut.of(counters),
        capture_id=None if live is None else live.row.id,
    )


class DeviceWatch:
    """Publishes devices that appear, disappear or change their state."""

    def __init__(self, captures: Captures, sources: Sources, bus: Bus) -> None:
        self._captures = captures
        self._sources = sources
        self._bus = bus
        self._over = threading.Event()
        self._published: dict[str, DeviceOut] = {}
        self._thread = threading.Thread(target=self._run, name="devices", daemon=True)

    def start(self) -> None:
        """Publish the current state of all devices, then check them every `_LOOK_S`."""
        self._thread.start()

    def stop(self) -> None:
        """Stop checking."""
        self._over.set()
        self._thread.join()

    def check(self) -> None:
        """Publish devices that changed since the last check; counters are not compared."""
        found = {device.source: shown(self._captures, device) for device in self._sources.devices()}
        for key, device in list(self._published.items()):
            if key not in found and device.state is not DeviceState.ABSENT:
                found[key] = device.model_copy(update={"state": DeviceState.ABSENT, "reason": "it was removed"})
        for key, device in found.items():
            state = device.model_copy(update={"counters": None})
            if self._published.get(key) != state:
                self._published[key] = state
                self._bus.publish(Topic.DEVICE, device, device.capture_id)

    def _run(self) -> None:
        while True:
            try:
                self.check()
            except SpikedError as error:
                _log.warning("the devices cannot be checked", reason=str(error))
            if self._over.wait(_LOOK_S):
                return
