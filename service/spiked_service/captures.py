"""All captures: live ones, those that are over, and those that were uploaded."""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import urlencode

from spiked_driver import open_source

from spiked.errors import ConfigurationError
from spiked.recording import sidecar_path
from spiked.sensor import Sensor
from spiked_service.announcer import Announcer
from spiked_service.capture import LiveCapture
from spiked_service.errors import BusyError
from spiked_service.ids import new_id
from spiked_service.judging import salvaged
from spiked_service.messages import AcquisitionOrder, PreviewTaken
from spiked_service.reconstructions import Reconstructions
from spiked_service.snapshot import Snapshot
from spiked_service.standby import Standby
from spiked_service.store.catalogue import Catalogue, Page, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, CaptureState, Judgement, Origin, Plan, Recorded, UploadRow
from spiked_service.stream import Stream

_CLOSE_S = 1.0
"""Workers end by themselves within 0.8 s of their dismissal; those that do not are killed."""
_RECENT = 32
"""Captures whose last pictures and counters are remembered."""
_TICK_S = 0.5
_BACKLOG_S = 1.7
"""A tracker pauses for about a second while it finds its first map; its reader may lag seven eighths of the ring."""


class Captures:
    """One live capture a device, any number of devices. Every method may be called from any thread."""

    def __init__(
        self, folder: DataFolder, catalogue: Catalogue, reconstructions: Reconstructions, announce: Announcer
    ) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._reconstructions = reconstructions
        self._announce = announce
        self._lock = threading.RLock()
        self._live: dict[str, LiveCapture] = {}
        self._armed: dict[str, Standby] = {}
        self._pictures: OrderedDict[str, PreviewTaken] = OrderedDict()
        self._ended: OrderedDict[str, CaptureRow] = OrderedDict()
        self._closing = threading.Event()
        # Looked for before this service can have captures of its own.
        over = (str(CaptureState.COMPLETE), str(CaptureState.FAILED))
        self._interrupted = catalogue.captures.where("state NOT IN (?, ?)", over)
        self._orphans = folder.contents()[0] - {row.id for row in catalogue.captures.where()}
        self._ticker = threading.Thread(target=self._tick, name="counters", daemon=True)
        self._ticker.start()

    def recover(self) -> None:
        """Make whole what an earlier service left unfinished; to be called once, while others may start captures."""
        while self._interrupted:
            row = self._interrupted[0]
            self._announce.log("warning", "the service ended during this capture", row.id)
            recording, verdict = None, None
            if row.plan.record:
                recording, verdict = salvaged(self._folder.recording(row.id), "the service ended during the capture")
            self._catalogue.captures.set(
                row.id,
                state=CaptureState.FAILED,
                reason=row.reason or "the service ended during the capture",
                recording=recording,
                verdict=verdict,
                ended_at=datetime.now(UTC),
            )
            self._interrupted.pop(0)
            self._announce.capture(self.get(row.id))
        for capture_id in self._orphans:
            self._folder.remove(self._folder.capture(capture_id))

    def start(self, plan: Plan) -> Snapshot:
        """Start a capture; with a pre-trigger time it begins in the past of an armed device.

        Raises BusyError while another one runs on the device, and when the service is about to end; SourceError,
        RecordingError or ConfigurationError for a source that cannot be captured from, StoreError when it cannot be
        noted.
        """
        if not (plan.record or plan.reconstruct):
            raise ConfigurationError(
                "a capture that neither records nor reconstructs does nothing: ask for one of them"
            )
        device = device_of(plan.source)
        with self._lock:
            standby = self._armed.get(device)
        if standby is not None:
            standby.check(plan)
        elif plan.pretrigger_s:
            raise ConfigurationError(
                f"{device} is not armed, so there is nothing from before now: arm the device first"
            )
        else:
            _check(plan)
        with self._lock:
            self._refuse_if_busy(device)
            standby = self._armed.pop(device, None)
            capture = self._noted(plan)
            if standby is None:
                try:
                    self._flow(capture, plan)
                except OSError as error:
                    del self._live[capture.id]
                    self._catalogue.captures.remove(capture.id)
                    self._folder.remove(self._folder.capture(capture.id))
                    raise BusyError(f"no worker can be started: {error.strerror}; end other programs") from error
        if standby is not None:
            standby.trigger(capture, plan)
        snapshot = self.get(capture.id)
        self._announce.capture(snapshot)
        return snapshot

    def _noted(self, plan: Plan) -> LiveCapture:
        """A new capture with its row and folder. Raises StoreError."""
        now = datetime.now(UTC)
        row = CaptureRow(new_id(), Origin.LIVE, plan, CaptureState.STARTING, now, name=plan.name, notes=plan.notes)
        self._catalogue.captures.put(row)
        try:
            (self._folder.capture(row.id) / "logs").mkdir(parents=True)
        except OSError as error:
            self._catalogue.captures.remove(row.id)
            raise StoreError(f"{self._folder.path} cannot be written: {error.strerror}") from error
        capture = LiveCapture(row, self._folder, self._catalogue, self._reconstructions, self._announce, self._changed)
        self._live[row.id] = capture
        return capture

    def arm(self, source: str, pretrigger_s: float) -> Standby:
        """Let a device run without recording, its newest frames kept in the ring for a capture that begins in the past.

        Raises as `start`.
        """
        device = device_of(source)
        _check(Plan(source, reconstruct=False))
        with self._lock:
            self._refuse_if_busy(device)
            if device in self._armed:
                raise BusyError(f"{device} is armed already: disarm it first to change what it keeps")
            standby = self._armed[device] = Standby(
                hurried(source), pretrigger_s, self._folder, self._announce, self._disarmed
            )
            return standby

    def disarm(self, source: str) -> None:
        """Let an armed device rest; nothing happens to one that is not armed."""
        with self._lock:
            standby = self._armed.pop(device_of(source), None)
        if standby is not None:
            standby.dismiss()
            standby.join(_CLOSE_S)

    def armed(self) -> dict[str, Standby]:
        """The devices that stand by."""
        with self._lock:
            return dict(self._armed)

    def get(self, capture_id: str) -> Snapshot:
        """As it stands now. Raises UnknownIdError."""
        with self._lock:
            live = self._live.get(capture_id)
        return self.snapshot(live.row if live is not None else self._catalogue.captures.get(capture_id))

    def snapshot(self, row: CaptureRow) -> Snapshot:
        """A row with all that is known of it now."""
        with self._lock:
            live = self._live.get(row.id)
        row = row if live is None else live.row
        counters = row.counters if live is None or row.state.over else live.counters()
        return Snapshot(row, counters, self._reconstructions.of(row.id))

    def list(
        self,
        limit: int = 50,
        cursor: str | None = None,
        query: str | None = None,
        state: CaptureState | None = None,
        deleted: bool = False,
    ) -> Page[CaptureRow]:
        """Newest first."""
        return self._catalogue.capture_page(limit, cursor, query, state, deleted)

    def live(self) -> Sequence[Snapshot]:
        """Those that are not over, oldest first."""
        with self._lock:
            captures = list(self._live.values())
        return [self.snapshot(capture.row) for capture in captures if not capture.row.state.over]

    def recent(self) -> Sequence[Snapshot]:
        """Those that are not over, and the last that were captured by this service."""
        with self._lock:
            rows = [*self._ended.values(), *(capture.row for capture in self._live.values())]
        return [self.snapshot(row) for row in {row.id: row for row in rows}.values()]

    def counts(self) -> dict[str, int]:
        """How many there are in each state, removed ones not counted."""
        found = self._catalogue.read("SELECT state, count(*) FROM captures WHERE deleted_at IS NULL GROUP BY state")
        return dict(found)

    def folder(self, capture_id: str) -> Path:
        """Where its files lie. Raises UnknownIdError."""
        return self._folder.capture(self._catalogue.captures.get(capture_id).id)

    def recording(self, capture_id: str) -> Path:
        """Its `.dat`; it may not be there, and grow while it is captured. Raises UnknownIdError."""
        return self._folder.recording(self._catalogue.captures.get(capture_id).id)

    def picture(self, capture_id: str) -> PreviewTaken | None:
        """The newest pictures of a capture that runs, or the last of one of this service; None if there are none."""
        with self._lock:
            live = self._live.get(capture_id)
            return self._pictures.get(capture_id) if live is None else live.picture

    def stop(self, capture_id: str) -> Snapshot:
        """End the acquisition; asked again, the refinement too. Raises UnknownIdError."""
        with self._lock:
            live = self._live.get(capture_id)
        if live is not None:
            live.stop()
        return self.get(capture_id)

    def update(
        self, capture_id: str, *, name: str | None = None, notes: str | None = None, keep: bool | None = None
    ) -> Snapshot:
        """Change what a user may change; None leaves it. Raises UnknownIdError."""
        fields = {"name": name, "notes": notes, "keep": keep}
        return self._change(capture_id, **{key: value for key, value in fields.items() if value is not None})

    def remove(self, capture_id: str) -> Snapshot:
        """Hide a capture, until it is restored or retention removes it for good. Raises UnknownIdError, BusyError."""
        snapshot = self.get(capture_id)
        if not snapshot.row.state.over:
            raise BusyError(f"capture {capture_id} is still {snapshot.row.state}: stop it first")
        for row in snapshot.reconstructions:
            self._reconstructions.cancel(row.id)
        return self._change(capture_id, deleted_at=snapshot.row.deleted_at or datetime.now(UTC))

    def restore(self, capture_id: str) -> Snapshot:
        """Undo `remove`. Raises UnknownIdError."""
        return self._change(capture_id, deleted_at=None)

    def purge(self, capture_id: str) -> None:
        """Remove a capture with all its files and reconstructions for good. Raises UnknownIdError, BusyError."""
        snapshot = self.get(capture_id)
        if not snapshot.row.state.over:
            raise BusyError(f"capture {capture_id} is still {snapshot.row.state}: stop it first")
        for row in snapshot.reconstructions:
            self._reconstructions.remove(row.id)
        self._folder.remove(self._folder.capture(capture_id))
        self._catalogue.captures.remove(capture_id)
        with self._lock:
            self._pictures.pop(capture_id, None)

    def adopt(
        self, upload: UploadRow, sensor: Sensor, recorded: Recorded, verdict: Judgement, notes: str = ""
    ) -> Snapshot:
        """Make an upload that a worker has checked, and described in a sidecar beside it, a capture of its own."""
        part = self._folder.upload(upload.id)
        now = datetime.now(UTC)
        row = CaptureRow(
            new_id(),
            Origin.UPLOAD,
            Plan(f"upload:{upload.name}", name=upload.name, reconstruct=False),
            CaptureState.COMPLETE,
            now,
            name=upload.name,
            notes=notes,
            sensor=sensor,
            recording=recorded,
            verdict=verdict,
            ended_at=now,
        )
        try:
            self._folder.capture(row.id).mkdir()
            data = self._folder.recording(row.id)
            part.with_suffix(".json").replace(sidecar_path(data))
            part.replace(data)
        except OSError as error:
            self._folder.remove(self._folder.capture(row.id))
            raise StoreError(f"the upload {upload.id} cannot be taken over: {error.strerror}") from error
        with self._catalogue.transaction():
            self._catalogue.captures.put(row)
            self._catalogue.uploads.set(upload.id, capture_id=row.id)
        snapshot = self.get(row.id)
        self._announce.capture(snapshot)
        return snapshot

    def processes(self) -> dict[str, dict[str, int]]:
        """Process ids of the living workers by capture and role, without reconstructions."""
        with self._lock:
            captures = list(self._live.values())
        return {capture.id: capture.processes() for capture in captures}

    def dismiss(self) -> None:
        """Tell every worker to leave at once; no capture can be started any more."""
        self._closing.set()
        for one in self._all():
            one.dismiss()
        self._reconstructions.dismiss()

    def close(self) -> None:
        """End every worker, within a moment."""
        self.dismiss()
        for one in self._all():
            one.join(_CLOSE_S)
        self._reconstructions.join(_CLOSE_S)
        self._ticker.join()

    def retry_saving(self) -> None:
        """Write down what a full disk did not take."""
        with self._lock:
            captures = list(self._live.values())
        for capture in captures:
            if capture.row.state.over and capture.save():
                with self._lock:
                    self._live.pop(capture.id, None)

    def _all(self) -> Sequence[LiveCapture | Standby]:
        with self._lock:
            return [*self._live.values(), *self._armed.values()]

    def _flow(self, capture: LiveCapture, plan: Plan) -> None:
        order = AcquisitionOrder(
            capture_id=capture.id,
            source=plan.source,
            ring_id=capture.id,
            frames=plan.frames,
            seconds=plan.seconds,
            consumers=1 + plan.record + plan.reconstruct,
            history_s=0.0,
            backlog_s=_BACKLOG_S if plan.reconstruct else 0.0,
        )
        logs = self._folder.capture(capture.id) / "logs"
        capture.flow(Stream(order, logs, self._folder.thumbnail(capture.id), capture))

    def _refuse_if_busy(self, device: str) -> None:
        if self._closing.is_set():
            raise BusyError("the service is about to end; start it again to capture")
        for other in self._live.values():
            if device_of(other.row.source) == device and not other.row.state.over and other.holds_device:
                raise BusyError(f"capture {other.id} is still running on {device}: stop it, or wait for its end")

    def _disarmed(self, standby: Standby) -> None:
        """An armed device has failed."""
        with self._lock:
            for device, one in list(self._armed.items()):
                if one is standby:
                    del self._armed[device]

    def _change(self, capture_id: str, **fields: object) -> Snapshot:
        with self._lock:
            live = self._live.get(capture_id)
        if live is not None:  # without the lock, which a capture takes when it changes
            live.change(**fields)
        else:
            self._catalogue.captures.set(capture_id, **fields)
        snapshot = self.get(capture_id)
        self._announce.capture(snapshot)
        return snapshot

    def _changed(self, capture: LiveCapture) -> None:
        self._announce.capture(self.snapshot(capture.row))
        if not capture.row.state.over:
            return
        with self._lock:
            self._ended[capture.id] = capture.row
            while len(self._ended) > _RECENT:
                self._ended.popitem(last=False)
            picture = capture.picture
            if picture is not None:
                self._pictures[capture.id] = picture
                while len(self._pictures) > _RECENT:
                    self._pictures.popitem(last=False)
            saved = self._catalogue.captures.find(capture.id)
            if saved is not None and saved.state.over:
                self._live.pop(capture.id, None)

    def _tick(self) -> None:
        while not self._closing.wait(_TICK_S):
            for snapshot in self.live():
                self._announce.capture(snapshot)


def device_of(source: str) -> str:
    """What can be captured from by one at a time: a camera whatever its options; of files and simulations each one."""
    kind, _, query = source.partition("?")
    if not kind.startswith(("replay:", "sim:")):
        return kind
    options = [option for option in query.split("&") if option and not option.startswith("pace=")]
    return f"{kind}?{'&'.join(options)}" if options else kind


def _check(plan: Plan) -> None:
    """Refuse at once what would fail a moment later in a worker."""
    open_source(plan.source)


def unhurried(source: str) -> str:
    """The source with `pace=0` unless it names a pace: files and simulations then wait for the reconstruction.

    A real camera cannot wait; a replay at its recorded rate, which loses what is not taken in time, is `pace=1`.
    """
    kind, _, query = source.partition("?")
    if not kind.startswith(("replay:", "sim:")) or "pace=" in query:
        return source
    return f"{kind}?{query}&{urlencode({'pace': 0})}" if query else f"{kind}?pace=0"


def hurried(source: str) -> str:
    """The source without `pace=0`: as fast as a camera, because nothing that stands by holds it up."""
    kind, _, query = source.partition("?")
    options = [option for option in query.split("&") if option and option != "pace=0"]
    return f"{kind}?{'&'.join(options)}" if options else kind
