"""What captures can be started from, and in which state it is."""

import threading
from dataclasses import asdict
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.routing import APIRoute

from spiked.errors import SpikedError
from spiked.ring import DeviceState
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import problems
from spiked_service.api.schemas.captures import ArmRequest, CapabilityOut, CountersOut, DeviceOut, DevicesOut
from spiked_service.api.sources import Sources
from spiked_service.captures import Captures, device_of, unhurried
from spiked_service.devices import Device
from spiked_service.events import Bus, Topic
from spiked_service.logs import logger
from spiked_service.store.catalogue import UnknownIdError

DeviceId = Annotated[str, Path(description="As `GET devices` names it, percent-encoded.", max_length=4096)]

_LOOK_S = 2.0
_log = logger("spiked.devices")


def device_routes(captures: Captures, sources: Sources, route_class: type[APIRoute]) -> APIRouter:
    """Routes below `devices`."""
    router = APIRouter(prefix="/devices", tags=["devices"], route_class=route_class)

    @router.get("", responses=problems())
    def list_devices() -> DevicesOut:
        """What captures can be started from."""
        return DevicesOut(items=[shown(captures, device) for device in sources.devices()])

    # Ids may hold slashes: replay:folder/file.dat. Hence the longer paths first.
    @router.post("/{device_id:device}:arm", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def arm_device(device_id: DeviceId, body: ArmRequest, idempotency_key: IdempotencyKey = None) -> DeviceOut:
        """Let it run without recording, so that a capture can begin up to `pretrigger_s` before it is asked for.

        This takes a moment; captures are taken from when its state is armed.
        """
        device = _find(sources, device_id)
        captures.arm(unhurried(device.source), body.pretrigger_s)
        return shown(captures, device)

    @router.post("/{device_id:device}:disarm", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def disarm_device(device_id: DeviceId, idempotency_key: IdempotencyKey = None) -> DeviceOut:
        """Let it rest; nothing happens to one that is not armed."""
        device = _find(sources, device_id)
        captures.disarm(unhurried(device.source))
        return shown(captures, device)

    @router.get("/{device_id:device}", responses=problems(404))
    def get_device(device_id: DeviceId) -> DeviceOut:
        """State, counters and capabilities of one."""
        return shown(captures, _find(sources, device_id))

    return router


def _find(sources: Sources, device_id: str) -> Device:
    for device in sources.devices():
        if device.source == device_id:
            return device
    raise UnknownIdError(f"there is no device {device_id}; GET devices lists them")


def shown(captures: Captures, device: Device) -> DeviceOut:
    """A device as it is now."""
    name = device_of(unhurried(device.source))
    live = next((one for one in captures.live() if device_of(one.row.source) == name), None)
    standby = captures.armed().get(name)
    state, reason, counters = device.state, device.reason, None
    warnings: tuple[str, ...] = ()
    if live is not None:
        counters, warnings = live.counters, live.row.warnings
        state, reason = DeviceState.STREAMING, ""
    elif standby is not None:
        counters, warnings = standby.counters(), standby.warnings
        state, reason = (device.state, device.reason) if counters is None else (DeviceState.ARMED, "")
    if counters is not None and (live is not None or counters.device is not DeviceState.STREAMING):
        state, reason = counters.device, counters.device_reason
    if standby is not None and state is not DeviceState.ARMED and not reason:
        reason = "being armed: a capture can begin when it is armed"
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
    """Tells the bus when a device comes, goes, or changes its state."""

    def __init__(self, captures: Captures, sources: Sources, bus: Bus) -> None:
        self._captures = captures
        self._sources = sources
        self._bus = bus
        self._over = threading.Event()
        self._told: dict[str, DeviceOut] = {}
        self._thread = threading.Thread(target=self._run, name="devices", daemon=True)

    def start(self) -> None:
        """Look every other second, and say how things stand at first."""
        self._thread.start()

    def stop(self) -> None:
        """Look no more."""
        self._over.set()
        self._thread.join()

    def look(self) -> None:
        """Tell of what has changed since the last look; counters alone are no change."""
        found = {device.source: shown(self._captures, device) for device in self._sources.devices()}
        for key, told in list(self._told.items()):
            if key not in found and told.state is not DeviceState.ABSENT:
                found[key] = told.model_copy(update={"state": DeviceState.ABSENT, "reason": "it is not there any more"})
        for key, device in found.items():
            state = device.model_copy(update={"counters": None})
            if self._told.get(key) != state:
                self._told[key] = state
                self._bus.publish(Topic.DEVICE, device, device.capture_id)

    def _run(self) -> None:
        while True:
            try:
                self.look()
            except SpikedError as error:
                _log.warning("the devices cannot be looked at", reason=str(error))
            if self._over.wait(_LOOK_S):
                return
