"""An armed device: its ring holds the last seconds, and standby workers wait for the trigger."""

from collections.abc import Callable
from pathlib import Path

from spiked_driver import open_camera

from spiked.errors import ConfigurationError
from spiked.sensor import Sensor
from spiked_service.base.errors import BusyError
from spiked_service.base.ids import new_id
from spiked_service.captures.acquisition import AcquisitionSupervisor
from spiked_service.captures.live_capture import LiveCapture
from spiked_service.captures.ring_counts import RingCount
from spiked_service.captures.sources import stated_options
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import Counters, Plan
from spiked_service.workers.messages import AcquisitionCommand, PreviewTaken, RingOpened, Role
from spiked_service.workers.process import StandbyWorker

_TRIGGER_S = 0.25
"""Additional time in the ring, so that the workers attach before the oldest frames are overwritten."""
MOST_S = 10.0
"""Longest pre-trigger time."""


class ArmedDevice:
    """An acquisition without a capture. Thread-safe."""

    def __init__(
        self,
        source: str,
        pretrigger_s: float,
        folder: DataFolder,
        notifier: Notifier,
        on_end: Callable[["ArmedDevice"], None],
    ) -> None:
        """Start the acquisition. Raises ConfigurationError if `pretrigger_s` is out of range."""
        if not 0 <= pretrigger_s <= MOST_S:
            raise ConfigurationError(f"a ring can keep 0 to {MOST_S:g} seconds, not {pretrigger_s:g}")
        self.source = source
        self.pretrigger_s = pretrigger_s
        self._notifier = notifier
        self._on_end = on_end
        self.trouble: str | None = None
        """Why it ended, if it failed."""
        logs = folder.path / "standby"
        logs.mkdir(exist_ok=True)
        self._standbys = [StandbyWorker(role, logs / f"{role}.log") for role in (Role.RECORDER, Role.RECONSTRUCTION)]
        command = AcquisitionCommand(
            source=source,
            ring_id=new_id(),
            frames=None,
            seconds=None,
            consumers=1,
            history_s=pretrigger_s + _TRIGGER_S,
            profiles=folder.profiles,
        )
        self._acquisition = AcquisitionSupervisor(command, logs, None, self)

    def counters(self) -> Counters | None:
        """Counters of the ring."""
        return self._acquisition.counters()

    def ring_count(self, *, over: bool = False) -> RingCount | None:
        """What the ring has counted; None before it exists."""
        return self._acquisition.ring_count(over)

    @property
    def sensor(self) -> Sensor:
        """The sensor; call `check` first."""
        assert self._acquisition.opened is not None, "checked before"
        return self._acquisition.opened.sensor

    @property
    def warnings(self) -> tuple[str, ...]:
        """Errors so far that did not end the acquisition."""
        return self._acquisition.warnings

    @property
    def picture(self) -> PreviewTaken | None:
        """The newest preview images."""
        return self._acquisition.picture

    def check(self, plan: Plan, profiles: Path) -> None:
        """Raises ConfigurationError if ring or camera do not fit the plan, BusyError before the ring exists."""
        if plan.pretrigger_s > self.pretrigger_s:
            raise ConfigurationError(
                f"{self.source} keeps {self.pretrigger_s:g} s, not {plan.pretrigger_s:g}: arm it with a longer time"
            )
        if self._acquisition.opened is None:
            raise BusyError(f"{self.source} is still being armed: try again in a moment")
        if stated_options(plan.source):
            wanted = open_camera(plan.source, profiles=profiles).source.sensor
            if wanted != self.sensor:
                raise ConfigurationError(
                    f"{self.source} is armed with other options than {plan.source}: disarm it, or start the capture "
                    "without options of the camera"
                )

    def trigger(self, capture: LiveCapture, plan: Plan) -> None:
        """Hand the acquisition to a capture that starts `plan.pretrigger_s` ago. Its length counts from now.

        Call once, after `check`.
        """
        opened, counters = self._acquisition.opened, self._acquisition.counters()
        assert opened is not None and counters is not None, "checked before"
        rate = opened.sensor.frame_rate_hz
        now = counters.next_frame
        first = max(0, now - round(plan.pretrigger_s * rate))
        length = plan.frames if plan.seconds is None else max(1, round(plan.seconds * rate))
        recorder, reconstructor = self._standbys
        capture.attach_running(
            self._acquisition,
            first,
            None if length is None else now + length,
            recorder if plan.record else None,
            reconstructor if plan.reconstruct else None,
        )
        for standby, used in ((recorder, plan.record), (reconstructor, plan.reconstruct)):
            if not used:
                standby.dismiss()

    def dismiss(self) -> None:
        """Ask its workers to exit at once."""
        self._acquisition.dismiss()
        for standby in self._standbys:
            standby.dismiss()

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers; kill those that have not exited after `timeout_s`."""
        self._acquisition.join(timeout_s)
        self._acquisition.release()
        for standby in self._standbys:
            standby.kill_after(timeout_s)

    def ring_opened(self, opened: RingOpened) -> None:
        """See `AcquisitionListener`."""

    def preview_taken(self, taken: PreviewTaken) -> None:
        """See `AcquisitionListener`."""
        self._notifier.preview(None, taken)

    def warned(self, text: str) -> None:
        """See `AcquisitionListener`."""
        self._notifier.log("warning", f"{self.source}: {text}")

    def acquisition_ended(self, trouble: str | None) -> None:
        """See `AcquisitionListener`."""
        self.trouble = trouble
        if trouble is not None:
            self._notifier.log("error", f"{self.source}: {trouble}")
        for standby in self._standbys:
            standby.dismiss()
        self._on_end(self)

    def acquisition_finished(self) -> None:
        """See `AcquisitionListener`."""
        self._acquisition.release()
