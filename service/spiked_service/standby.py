"""An armed device: it runs, its ring keeps the last seconds, and workers stand by for the trigger."""

from collections.abc import Callable

from spiked.errors import ConfigurationError
from spiked_service.announcer import Announcer
from spiked_service.capture import LiveCapture
from spiked_service.child import Spare
from spiked_service.errors import BusyError
from spiked_service.ids import new_id
from spiked_service.messages import AcquisitionOrder, PreviewTaken, RingOpened, Role
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import Counters, Plan
from spiked_service.stream import Stream

_TRIGGER_S = 0.25
"""Kept beyond what was asked for, so that the workers can still reach the oldest frames."""
MOST_S = 10.0


class Standby:
    """A stream without a capture. Every method may be called from any thread."""

    def __init__(
        self,
        source: str,
        pretrigger_s: float,
        folder: DataFolder,
        announce: Announcer,
        on_end: Callable[["Standby"], None],
    ) -> None:
        """Start it. Raises ConfigurationError for a time that no ring keeps."""
        if not 0 <= pretrigger_s <= MOST_S:
            raise ConfigurationError(f"a ring can keep 0 to {MOST_S:g} seconds, not {pretrigger_s:g}")
        self.source = source
        self.pretrigger_s = pretrigger_s
        self._announce = announce
        self._on_end = on_end
        self.trouble: str | None = None
        """Why it ended, if it did by itself."""
        logs = folder.path / "standby"
        logs.mkdir(exist_ok=True)
        self._spares = [Spare(role, logs / f"{role}.log") for role in (Role.RECORDER, Role.RECONSTRUCTION)]
        order = AcquisitionOrder(
            source=source,
            ring_id=new_id(),
            frames=None,
            seconds=None,
            consumers=1,
            history_s=pretrigger_s + _TRIGGER_S,
        )
        self._stream = Stream(order, logs, None, self)

    def counters(self) -> Counters | None:
        """Of the ring."""
        return self._stream.counters()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What went wrong so far and was mended or done without."""
        return self._stream.warnings

    @property
    def picture(self) -> PreviewTaken | None:
        """The newest pictures."""
        return self._stream.picture

    def check(self, plan: Plan) -> None:
        """Raises ConfigurationError for a longer time than is kept, BusyError before the ring is there."""
        if plan.pretrigger_s > self.pretrigger_s:
            raise ConfigurationError(
                f"{self.source} keeps {self.pretrigger_s:g} s, not {plan.pretrigger_s:g}: arm it with a longer time"
            )
        if self._stream.opened is None:
            raise BusyError(f"{self.source} is only just being armed: try again in a moment")

    def trigger(self, capture: LiveCapture, plan: Plan) -> None:
        """Make the stream that of a capture that begins `plan.pretrigger_s` ago; its length counts from now.

        To be called once, after `check`.
        """
        opened, counters = self._stream.opened, self._stream.counters()
        assert opened is not None and counters is not None, "checked before"
        rate = opened.sensor.frame_rate_hz
        now = counters.next_frame
        first = max(0, now - round(plan.pretrigger_s * rate))
        length = plan.frames if plan.seconds is None else max(1, round(plan.seconds * rate))
        recorder, reconstructor = self._spares
        capture.join_stream(
            self._stream,
            first,
            None if length is None else now + length,
            recorder if plan.record else None,
            reconstructor if plan.reconstruct else None,
        )
        for spare, used in ((recorder, plan.record), (reconstructor, plan.reconstruct)):
            if not used:
                spare.dismiss()

    def dismiss(self) -> None:
        """Tell its workers to leave at once."""
        self._stream.dismiss()
        for spare in self._spares:
            spare.dismiss()

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers, and kill those that stay."""
        self._stream.join(timeout_s)
        for spare in self._spares:
            spare.kill_after(timeout_s)

    def stream_opened(self, opened: RingOpened) -> None:
        """See `StreamListener`."""

    def picture_taken(self, taken: PreviewTaken) -> None:
        """See `StreamListener`."""
        self._announce.preview(None, taken)

    def warned(self, text: str) -> None:
        """See `StreamListener`."""
        self._announce.log("warning", f"{self.source}: {text}")

    def stream_ended(self, trouble: str | None) -> None:
        """See `StreamListener`."""
        self.trouble = trouble
        if trouble is not None:
            self._announce.log("error", f"{self.source}: {trouble}")
        for spare in self._spares:
            spare.dismiss()
        self._on_end(self)

    def stream_settled(self) -> None:
        """See `StreamListener`."""
