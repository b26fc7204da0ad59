"""What captures can be started from, and in which state it is."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.routing import APIRoute

from spiked.ring import DeviceState
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import problems
from spiked_service.api.schemas.captures import ArmRequest, CountersOut, DeviceOut, DevicesOut
from spiked_service.api.sources import Sources
from spiked_service.captures import Captures, device_of, unhurried
from spiked_service.devices import Device
from spiked_service.store.catalogue import UnknownIdError

DeviceId = Annotated[str, Path(description="As `GET devices` names it, percent-encoded.", max_length=4096)]


def device_routes(captures: Captures, sources: Sources, route_class: type[APIRoute]) -> APIRouter:
    """Routes below `devices`."""
    router = APIRouter(prefix="/devices", tags=["devices"], route_class=route_class)

    @router.get("", responses=problems())
    def list_devices() -> DevicesOut:
        """What captures can be started from."""
        return DevicesOut(items=[_out(captures, device) for device in sources.devices()])

    # Ids may hold slashes: replay:folder/file.dat. Hence the longer paths first.
    @router.post("/{device_id:device}:arm", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def arm_device(device_id: DeviceId, body: ArmRequest, idempotency_key: IdempotencyKey = None) -> DeviceOut:
        """Let it run without recording, so that a capture can begin up to `pretrigger_s` before it is asked for."""
        device = _find(sources, device_id)
        captures.arm(unhurried(device.source), body.pretrigger_s)
        return _out(captures, device)

    @router.post("/{device_id:device}:disarm", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def disarm_device(device_id: DeviceId, idempotency_key: IdempotencyKey = None) -> DeviceOut:
        """Let it rest; nothing happens to one that is not armed."""
        device = _find(sources, device_id)
        captures.disarm(unhurried(device.source))
        return _out(captures, device)

    @router.get("/{device_id:device}", responses=problems(404))
    def get_device(device_id: DeviceId) -> DeviceOut:
        """State, counters and capabilities of one."""
        return _out(captures, _find(sources, device_id))

    return router


def _find(sources: Sources, device_id: str) -> Device:
    for device in sources.devices():
        if device.source == device_id:
            return device
    raise UnknownIdError(f"there is no device {device_id}; GET devices lists them")


def _out(captures: Captures, device: Device) -> DeviceOut:
    name = device_of(unhurried(device.source))
    live = next((one for one in captures.live() if device_of(one.row.source) == name), None)
    standby = captures.armed().get(name)
    state, reason = DeviceState.IDLE, ""
    counters = None
    if live is not None:
        counters = CountersOut.of(live.counters)
        state = DeviceState.STREAMING if live.counters is None else live.counters.device
        reason = "" if live.counters is None else live.counters.device_reason
    elif standby is not None:
        state = DeviceState.ARMED
    return DeviceOut(
        id=device.source,
        kind=device.kind,
        source=device.source,
        description=device.description,
        state=state,
        reason=reason,
        counters=counters,
        capture_id=None if live is None else live.row.id,
    )
