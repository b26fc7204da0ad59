"""Devices: their state, and arming them for pre-trigger captures."""

import threading
from dataclasses import asdict
from http import HTTPStatus
from pathlib import Path
from typing import Annotated

import fastapi
from fastapi import APIRouter
from fastapi.routing import APIRoute
from spiked_driver import open_camera
from spiked_driver.source_kind import Device, SourceSpec
from spiked_driver.spec import stored_profile

from spiked.camera import CameraFiles
from spiked.errors import SpikedError
from spiked.profile import CameraProfile, profile_path
from spiked.ring import DeviceState
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import ConflictError, problems
from spiked_service.api.schemas.captures import (
    ArmRequest,
    CapabilityOut,
    CountersOut,
    DeviceOut,
    DevicesOut,
    ProfileModel,
    ProfileOut,
)
from spiked_service.api.sources import Sources
from spiked_service.base.ids import new_id
from spiked_service.captures.captures import Captures
from spiked_service.captures.sources import device_of, unpaced, with_options
from spiked_service.events.bus import Bus, Topic
from spiked_service.events.logging import logger
from spiked_service.store.catalogue import UnknownIdError

DeviceId = Annotated[str, fastapi.Path(description="As `GET devices` names it, percent-encoded.", max_length=4096)]

_LOOK_S = 2.0
"""Interval at which devices are checked, seconds."""
_log = logger("spiked.devices")


def device_routes(captures: Captures, sources: Sources, profiles: Path, route_class: type[APIRoute]) -> APIRouter:
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

    _add_profile_routes(router, sources, profiles)

    @router.get("/{device_id:device}", responses=problems(404))
    def get_device(device_id: DeviceId) -> DeviceOut:
        """State, counters and capabilities of a device."""
        return shown(captures, _find(sources, device_id))

    return router


def _add_profile_routes(router: APIRouter, sources: Sources, profiles: Path) -> None:
    """Routes that read, write and remove the profile of a device."""

    @router.get("/{device_id:device}/profile", responses=problems(404))
    def get_device_profile(device_id: DeviceId) -> ProfileOut:
        """What captures of the device take from its profile."""
        path = _profile_of(sources, profiles, device_id)
        return ProfileOut(file=path.name, profile=ProfileModel(**CameraProfile.read(path).model_dump()))

    @router.put("/{device_id:device}/profile", responses=problems(404, 409))
    def set_device_profile(device_id: DeviceId, body: ProfileModel) -> ProfileOut:
        """Replace the profile of the device; captures that run keep theirs. It is checked and survives a restart.

        It is kept by the camera's serial number, or by the device's id if the number is missing or not its own.
        """
        device = _find(sources, device_id)
        if body.serial is not None and device.serial is not None and body.serial != device.serial:
            raise ConflictError(f"the profile is of camera {body.serial}, and {device_id} is camera {device.serial}")
        if body.calibration is not None:
            sources.check_file(str(profiles / body.calibration), profiles)
        address = SourceSpec.parse(device.source).address
        path = profile_path(profiles, address, device.serial)
        # Opened with the profile before it replaces the one before: an impossible one is refused.
        trial = path.with_name(f".{path.name}.{new_id()}.part")
        try:
            body.write(trial)
            open_camera(with_options(device.source, CameraFiles(profile=trial)))
            trial.replace(path)
        finally:
            trial.unlink(missing_ok=True)
        return ProfileOut(file=path.name, profile=body)

    @router.delete("/{device_id:device}/profile", status_code=HTTPStatus.NO_CONTENT, responses=problems(404))
    def remove_device_profile(device_id: DeviceId) -> None:
        """Remove the profile of the device."""
        _profile_of(sources, profiles, device_id).unlink(missing_ok=True)


def _profile_of(sources: Sources, profiles: Path, device_id: str) -> Path:
    """The file of a device's profile. Raises UnknownIdError without one."""
    path = stored_profile(_find(sources, device_id), profiles)
    if path is None:
        raise UnknownIdError(f"device {device_id} has no profile; PUT one")
    return path


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
