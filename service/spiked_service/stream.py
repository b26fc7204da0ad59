"""A source flowing into a ring, with pictures of it: what a capture needs, and what can stand by before one."""

import threading
import time
from pathlib import Path
from typing import Protocol

from spiked_driver.spec import is_camera

from spiked.ring import Ring, clean_stale
from spiked_service.backoff import Backoff
from spiked_service.child import Child, Spare
from spiked_service.messages import (
    AcquisitionOrder,
    News,
    PreviewOrder,
    PreviewTaken,
    Refused,
    RingOpened,
    Role,
    Warned,
)
from spiked_service.store.rows import Counters


class StreamListener(Protocol):
    """Whoever follows a stream; called from its threads."""

    def stream_opened(self, opened: RingOpened) -> None:
        """The ring is there, and the first frame waits for its readers."""

    def picture_taken(self, taken: PreviewTaken) -> None:
        """There is a newer picture."""

    def warned(self, text: str) -> None:
        """Something went wrong that the stream could mend, or does without."""

    def stream_ended(self, trouble: str | None) -> None:
        """No more frames will come; the ring can be read to its end."""

    def stream_settled(self) -> None:
        """After that, its workers have left."""


class Stream:
    """Supervises acquisition and preview. Every method may be called from any thread."""

    def __init__(self, order: AcquisitionOrder, logs: Path, thumbnail: Path | None, listener: StreamListener) -> None:
        """Start acquiring."""
        self._order = order
        self._logs = logs
        self._thumbnail = thumbnail
        self._listener = listener
        self._lock = threading.RLock()
        self._ring: Ring | None = None
        self._opened: RingOpened | None = None
        self._picture: PreviewTaken | None = None
        self._refusal: str | None = None
        self._closing = False
        self._stopping = False
        self._orphaned = False  # the acquisition has died, and another is about to be started
        self._ended = False
        self._final: Counters | None = None
        self._backoff = Backoff()
        self._acquisition_backoff = Backoff()
        self._warnings: list[str] = []
        self._children: dict[Role, Child] = {}
        with self._lock:
            self._acquire(order)

    @property
    def opened(self) -> RingOpened | None:
        """The ring, once it is there."""
        return self._opened

    @property
    def picture(self) -> PreviewTaken | None:
        """The newest picture."""
        return self._picture

    @property
    def warnings(self) -> tuple[str, ...]:
        """What went wrong so far and was mended or done without."""
        return tuple(self._warnings)

    @property
    def ended(self) -> bool:
        """Whether the source is free again."""
        return self._ended

    @property
    def settled(self) -> bool:
        """Whether all its workers have left, too."""
        return self._ended and not self._children

    def follow(self, listener: StreamListener) -> None:
        """Tell another one from now on."""
        with self._lock:
            self._listener = listener

    def counters(self) -> Counters | None:
        """Of the ring, now or as they were at the end; None before it is there."""
        with self._lock:
            if self._ring is not None:
                self._final = Counters.of(self._ring.status())
            return self._final

    def bury(self, role: Role) -> None:
        """Let a source that waits not wait for a killed consumer of that name, as it has no successor."""
        with self._lock:
            if self._ring is not None:
                self._ring.bury(role)

    def release(self) -> None:
        """Let go of the ring's memory; the counters stay as they are now."""
        with self._lock:
            self.counters()
            self._ring = None

    def stop(self) -> None:
        """End the acquisition in good order."""
        with self._lock:
            self._stopping = True
            child = self._children.get(Role.ACQUISITION)
            waiting = self._orphaned
        if child is not None:
            child.stop()
        elif waiting:
            self._give_up("the acquisition had died when it was stopped")

    def dismiss(self) -> None:
        """Tell the workers to leave at once."""
        with self._lock:
            self._closing = True
            self._backoff.cancel()
            children = list(self._children.values())
            waiting = self._orphaned
        for child in children:
            child.dismiss()
        if waiting:
            self._give_up(None)

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers, and kill those that stay."""
        with self._lock:
            children = list(self._children.values())
        for child in children:
            child.kill_after(timeout_s)

    def processes(self) -> dict[str, int]:
        """Process ids of the living workers, by role."""
        with self._lock:
            return {role: child.pid for role, child in self._children.items()}

    def _hear(self, news: News) -> None:
        match news:
            case RingOpened():
                with self._lock:
                    self._opened = news
                    self._ring = Ring.attach(news.name)
                    self._start_preview()
                self._listener.stream_opened(news)
            case PreviewTaken():
                self._picture = news
                self._listener.picture_taken(news)
            case Warned() if news.text not in self._warnings:  # each acquisition notes the same
                self._warn(news.text)
            case Refused():
                self._refusal = news.reason

    def _warn(self, text: str) -> None:
        self._warnings.append(text)
        self._listener.warned(text)

    def _acquire(self, order: AcquisitionOrder) -> None:
        self._children[Role.ACQUISITION] = Child(
            order, self._logs / "acquisition.log", self._hear, self._acquisition_ended
        )

    def _acquisition_ended(self, trouble: str | None) -> None:
        died_s = time.monotonic()
        with self._lock:
            self._children.pop(Role.ACQUISITION, None)
            follows = self._orphaned = trouble is not None and self._hold(trouble)
        if follows and self._acquisition_backoff.again(lambda: self._succeed(died_s)) is not None:
            self._warn(f"{trouble}; another goes on, and what came meanwhile is lost")
            return
        if follows:
            trouble = f"{trouble}, again and again"
        self._give_up(trouble)

    def _hold(self, trouble: str) -> bool:
        """Whether an acquisition that has died is to be followed: a camera cannot be asked again for what it saw."""
        if self._closing or self._stopping or self._ring is None or not is_camera(self._order.source):
            return False
        return self._refusal is None and self._ring.hold(f"{trouble}: another is being started")

    def _succeed(self, died_s: float) -> None:
        with self._lock:
            if self._closing or self._stopping or self._ended or self._opened is None:
                return
            again = {"ring": self._opened.name, "died_s": died_s}
            try:
                self._acquire(self._order.model_copy(update=again))
                self._orphaned = False
                return
            except OSError as error:
                trouble = f"the acquisition cannot be started again: {error}"
        self._give_up(trouble)

    def _give_up(self, trouble: str | None) -> None:
        """No more frames will come."""
        with self._lock:
            if self._ended:
                return
            self._acquisition_backoff.cancel()
            if self._ring is not None:
                self._ring.give_up()
            clean_stale()  # a killed acquisition leaves its ring
            self._ended = True
            if self._opened is None:
                self._backoff.cancel()
            reason = None if self._closing else self._refusal or trouble
            settled = self.settled
        self._listener.stream_ended(reason)
        if settled:
            self._listener.stream_settled()

    def _start_preview(self, spare: Spare | None = None) -> None:
        with self._lock:
            if self._closing or self._ended or self._opened is None:
                return
            order = PreviewOrder(capture_id=self._order.capture_id, ring=self._opened.name, thumbnail=self._thumbnail)
            self._children[Role.PREVIEW] = Child(
                order, self._logs / "preview.log", self._hear, self._preview_ended, spare
            )

    def _preview_ended(self, trouble: str | None) -> None:
        with self._lock:
            self._children.pop(Role.PREVIEW, None)
            settled = self.settled
            if trouble is not None and not self._closing and not self._ended:
                delay_s = self._backoff.again(self._start_preview)
                how = "there is no live picture" if delay_s is None else "it was started again"
            else:
                trouble = None
        if trouble is not None:
            self._warn(f"{trouble}; {how}")
        if settled:
            self._listener.stream_settled()
