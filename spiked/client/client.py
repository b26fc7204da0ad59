"""The service as an object: devices, captures, reconstructions, what they give, uploads, events, settings."""

import time
from collections.abc import Callable, Iterator, Sequence
from http import HTTPStatus
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar
from urllib.parse import quote

import httpx

from spiked.client.connection import Connection, plain
from spiked.client.editing import EditingMethods
from spiked.client.events import Event, events_in
from spiked.client.frames import FrameMethods
from spiked.client.maps import MapMethods
from spiked.client.models import (
    CalibratedOut,
    CalibrationRequest,
    CaptureOut,
    CapturePage,
    CaptureRequest,
    CaptureState,
    DeviceOut,
    DevicesOut,
    GroupOut,
    IntrinsicsModel,
    JobState,
    NoiseModel,
    ProfileModel,
    ProfileOut,
    ReconstructionOptions,
    ReconstructionOut,
    ReconstructionPage,
    StatedCameraModel,
    SystemOut,
)
from spiked.client.results import ResultMethods
from spiked.client.settings import SettingMethods
from spiked.client.uploads import UploadMethods
from spiked.errors import SpikedError
from spiked.recording import remove_recording, sidecar_path
from spiked.whole_files import write_atomically

_HASH_BYTES = 1 << 20
"""Bytes read at a time."""
_POLL_S = 0.2
"""Interval at which the state of a job is polled, seconds."""
_T = TypeVar("_T")
_OVER = (JobState.complete, JobState.cancelled, JobState.failed)


class Spiked(MapMethods, ResultMethods, EditingMethods, FrameMethods, SettingMethods, UploadMethods):
    """A client of one service. Usable from any thread, and as a context manager.

    Every method raises ApiError when the service refuses, and ServiceUnreachableError when it does not answer.
    """

    def __init__(
        self, address: str = "http://127.0.0.1:8650", *, token: str | None = None, timeout_s: float = 60.0
    ) -> None:
        self._connection = Connection(address, token, timeout_s)

    def close(self) -> None:
        """Let go of the connections."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def system(self) -> SystemOut:
        """Version, uptime, disk and memory of the service."""
        return self._connection.get("system", SystemOut)

    def devices(self) -> list[DeviceOut]:
        """What captures can be started from."""
        return self._connection.get("devices", DevicesOut).items

    def profile(self, device: str) -> ProfileModel:
        """The camera profile of a device. Raises ApiError if it has none."""
        return self._connection.get(f"devices/{quote(device, safe='')}/profile", ProfileOut).profile

    def set_profile(self, device: str, profile: ProfileModel) -> None:
        """Replace the camera profile of a device."""
        self._connection.request("PUT", f"devices/{quote(device, safe='')}/profile", json=plain(profile))

    def calibrate(self, device: str, *, dark: str | None = None, flat: str | None = None) -> CalibratedOut:
        """Measure gains and dark rates of a camera by captures in the dark and of an even light; one or both."""
        body = plain(CalibrationRequest(dark=dark, flat=flat))
        path = f"devices/{quote(device, safe='')}/profile:calibrate"
        return CalibratedOut.model_validate(self._connection.request("POST", path, json=body).json())

    def options(self) -> dict[str, Any]:
        """JSON Schema of the options of a reconstruction."""
        return dict(self._connection.request("GET", "options").json())

    def start_capture(
        self,
        source: str,
        *,
        frames: int | None = None,
        seconds: float | None = None,
        pretrigger_s: float = 0.0,
        name: str = "",
        notes: str = "",
        record: bool = True,
        reconstruct: bool = True,
        options: ReconstructionOptions | None = None,
        camera: StatedCameraModel | None = None,
        noise: NoiseModel | None = None,
        intrinsics: IntrinsicsModel | None = None,
    ) -> CaptureOut:
        """Start a capture of so many frames or seconds, or until it is stopped."""
        body = {
            "source": source,
            "frames": frames,
            "seconds": seconds,
            "pretrigger_s": pretrigger_s,
            "name": name,
            "notes": notes,
            "record": record,
            "reconstruct": reconstruct,
            "options": plain(options or ReconstructionOptions()),
            "camera": plain(camera),
            "noise": None if noise is None else noise.model_dump(mode="json", exclude_unset=True),
            "intrinsics": plain(intrinsics),
        }
        return self._connection.post("captures", body, CaptureOut)

    def start_group(self, captures: Sequence[CaptureRequest]) -> GroupOut:
        """Start captures on several devices together, or none of them."""
        return self._connection.post("groups", {"captures": [plain(one) for one in captures]}, GroupOut)

    def group(self, group_id: str) -> GroupOut:
        """Captures that were started together; when all have ended, with the offset of each against the first."""
        return self._connection.get(f"groups/{group_id}", GroupOut)

    def stop_group(self, group_id: str) -> GroupOut:
        """End the acquisition of all its captures."""
        return self._connection.post(f"groups/{group_id}:stop", None, GroupOut)

    def captures(
        self,
        *,
        query: str | None = None,
        state: CaptureState | None = None,
        deleted: bool = False,
        group: str | None = None,
    ) -> Iterator[CaptureOut]:
        """All captures, newest first; pages are fetched as they are needed."""
        cursor = None
        while True:
            page = self._connection.get(
                "captures", CapturePage, q=query, state=state, deleted=deleted or None, cursor=cursor, group=group
            )
            yield from page.items
            cursor = page.next_cursor
            if cursor is None:
                return

    def capture(self, capture_id: str) -> CaptureOut:
        """One capture."""
        return self._connection.get(f"captures/{capture_id}", CaptureOut)

    def stop_capture(self, capture_id: str) -> CaptureOut:
        """End the acquisition; asked again, the refinement too."""
        return self._connection.post(f"captures/{capture_id}:stop", None, CaptureOut)

    def change_capture(
        self, capture_id: str, *, name: str | None = None, notes: str | None = None, keep: bool | None = None
    ) -> CaptureOut:
        """Change what is given."""
        given = {"name": name, "notes": notes, "keep": keep}
        body = {key: value for key, value in given.items() if value is not None}
        return self._connection.change("PATCH", f"captures/{capture_id}", body, CaptureOut)

    def remove_capture(self, capture_id: str) -> None:
        """Remove it; `restore_capture` brings it back for some days."""
        self._connection.request("DELETE", f"captures/{capture_id}")

    def restore_capture(self, capture_id: str) -> CaptureOut:
        """Undo its removal."""
        return self._connection.post(f"captures/{capture_id}:restore", None, CaptureOut)

    def purge_capture(self, capture_id: str) -> None:
        """Delete a removed capture with its files for good, before retention does."""
        self._connection.request("POST", f"captures/{capture_id}:purge")

    def wait_for_capture(self, capture_id: str, timeout_s: float = 600.0) -> CaptureOut:
        """The capture when it is over. Raises SpikedError if it is not in time."""
        over = (CaptureState.complete, CaptureState.failed)
        return _wait(lambda: self.capture(capture_id), lambda one: one.state in over, timeout_s)

    def save_recording(self, capture_id: str, path: Path | str) -> Path:
        """Write the `.dat` and its sidecar; a download that broke off goes on where it ended.

        An earlier recording of that name is replaced with its sidecar and index when the new one is here.
        """
        return _download(self._connection, self.capture(capture_id), Path(path))

    def start_reconstruction(
        self,
        capture_id: str,
        *,
        options: ReconstructionOptions | None = None,
        priority: int = 0,
        map_id: str | None = None,
    ) -> ReconstructionOut:
        """Reconstruct a recording; it may wait in line. With `map_id` it extends the map of that reconstruction."""
        options = options or ReconstructionOptions()
        body = {"capture_id": capture_id, "options": plain(options), "priority": priority, "map": map_id}
        return self._connection.post("reconstructions", body, ReconstructionOut)

    def reconstructions(
        self, *, capture_id: str | None = None, state: JobState | None = None
    ) -> Iterator[ReconstructionOut]:
        """All reconstructions, newest first."""
        cursor = None
        while True:
            page = self._connection.get(
                "reconstructions", ReconstructionPage, capture_id=capture_id, state=state, cursor=cursor
            )
            yield from page.items
            cursor = page.next_cursor
            if cursor is None:
                return

    def reconstruction(self, reconstruction_id: str) -> ReconstructionOut:
        """One reconstruction."""
        return self._connection.get(f"reconstructions/{reconstruction_id}", ReconstructionOut)

    def cancel_reconstruction(self, reconstruction_id: str) -> ReconstructionOut:
        """End it; what it has published stays."""
        return self._connection.post(f"reconstructions/{reconstruction_id}:cancel", None, ReconstructionOut)

    def restart_reconstruction(
        self, reconstruction_id: str, options: ReconstructionOptions | None = None
    ) -> ReconstructionOut:
        """Begin anew from the recording."""
        body = {"options": plain(options)}
        return self._connection.post(f"reconstructions/{reconstruction_id}:restart", body, ReconstructionOut)

    def change_reconstruction(
        self,
        reconstruction_id: str,
        *,
        name: str | None = None,
        notes: str | None = None,
        held: bool | None = None,
        queue_place: int | None = None,
    ) -> ReconstructionOut:
        """Change what is given: texts, or whether and where (from 1) it waits in the queue."""
        given = {"name": name, "notes": notes, "held": held, "queue_place": queue_place}
        body = {key: value for key, value in given.items() if value is not None}
        return self._connection.change("PATCH", f"reconstructions/{reconstruction_id}", body, ReconstructionOut)

    def remove_reconstruction(self, reconstruction_id: str) -> None:
        """Remove it for good."""
        self._connection.request("DELETE", f"reconstructions/{reconstruction_id}")

    def wait_for_reconstruction(self, reconstruction_id: str, timeout_s: float = 3600.0) -> ReconstructionOut:
        """The reconstruction when it is over. Raises SpikedError if it is not in time."""
        return _wait(lambda: self.reconstruction(reconstruction_id), lambda one: one.state in _OVER, timeout_s)

    def events(self, *, topics: Sequence[str] | None = None, since: int | None = None) -> Iterator[Event]:
        """Messages from now on, or after the number `since`, for as long as they are taken."""
        wanted = ",".join(topics) if topics else None
        with self._connection.stream("events", topics=wanted, since=since) as answer:
            yield from events_in(answer.iter_lines())


def _download(connection: Connection, capture: CaptureOut, path: Path) -> Path:
    part = path.with_name(f"{path.name}.{capture.id}.part")
    done, recording = part.stat().st_size if part.exists() else 0, capture.recording
    if recording is not None and done > recording.bytes:
        done = 0
    if recording is None or done < recording.bytes:
        headers = {"Range": f"bytes={done}-"} if done else {}
        with connection.stream(f"captures/{capture.id}/recording", headers) as answer:
            _append(part, answer)
    sidecar = connection.request("GET", f"captures/{capture.id}/recording/sidecar")
    remove_recording(path)  # frames beside the sidecar or the index of others would be read by these
    part.replace(path)
    write_atomically(sidecar_path(path), sidecar.content)
    return path


def _append(part: Path, answer: httpx.Response) -> None:
    with part.open("ab" if answer.status_code == HTTPStatus.PARTIAL_CONTENT else "wb") as file:
        for chunk in answer.iter_bytes(_HASH_BYTES):
            file.write(chunk)


def _wait(ask: Callable[[], _T], over: Callable[[_T], bool], timeout_s: float) -> _T:
    deadline = time.monotonic() + timeout_s
    while not over(one := ask()):
        if time.monotonic() > deadline:
            raise SpikedError(f"still not over after {timeout_s:g} s: {one}")
        time.sleep(_POLL_S)
    return one
