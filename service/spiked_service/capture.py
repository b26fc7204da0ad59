"""One capture: three workers, what they said last, and what became of them."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from spiked.ring import Ring, RingStatus, clean_stale
from spiked.sensor import Intrinsics
from spiked_service.child import Child
from spiked_service.ids import new_id
from spiked_service.messages import (
    AcquisitionOrder,
    News,
    Order,
    PreviewOrder,
    ReconstructionOrder,
    ReconstructionStatus,
    Refused,
    RingOpened,
)

_CONSUMERS = 2  # reconstruction and preview
_PREVIEW_RETRIES = 3


class CaptureState(StrEnum):
    """Where a capture stands."""

    STARTING = "starting"
    STREAMING = "streaming"
    FINISHING = "finishing"
    """The source has ended; the reconstruction refines what it has."""
    COMPLETE = "complete"
    FAILED = "failed"
    """Something died or was refused, the reason says what; what was published stays available."""

    @property
    def over(self) -> bool:
        """Whether nothing more will happen."""
        return self in (CaptureState.COMPLETE, CaptureState.FAILED)


@dataclass(frozen=True)
class Plan:
    """What to capture, and how to reconstruct it."""

    source: str
    frames: int | None = None
    """None: until the source ends or the capture is stopped."""
    seconds: float | None = None
    """Instead of frames."""
    seed: int = 0
    steps: int = 4000
    intrinsics: Intrinsics | None = None
    """None: the source's own."""


@dataclass(frozen=True)
class Snapshot:
    """All that is known of a capture at one moment."""

    id: str
    plan: Plan
    started: datetime
    state: CaptureState
    reason: str
    warnings: tuple[str, ...]
    ring: RingOpened | None
    counters: RingStatus | None
    reconstruction: ReconstructionStatus | None


class Capture:
    """Supervises acquisition, reconstruction and preview. Every method may be called from any thread."""

    def __init__(self, plan: Plan, runtime: Path) -> None:
        self.id = new_id()
        self.plan = plan
        self.folder = runtime / self.id
        self.folder.mkdir()
        self._lock = threading.RLock()
        self._started = datetime.now(UTC)
        self._state = CaptureState.STARTING
        self._reason = ""
        self._warnings: list[str] = []
        self._opened: RingOpened | None = None
        self._ring: Ring | None = None
        self._reconstruction: ReconstructionStatus | None = None
        self._children: dict[str, Child] = {}
        self._closing = False
        self._preview_deaths = 0
        order = AcquisitionOrder(
            source=plan.source, ring_id=self.id, frames=plan.frames, seconds=plan.seconds, consumers=_CONSUMERS
        )
        self._start(order, self._acquisition_ended)

    @property
    def preview(self) -> Path:
        """Where the live picture is, once there is one."""
        return self.folder / "preview.png"

    def snapshot(self) -> Snapshot:
        """What is known now."""
        with self._lock:
            counters = None if self._ring is None else self._ring.status()
            return Snapshot(
                self.id,
                self.plan,
                self._started,
                self._state,
                self._reason,
                tuple(self._warnings),
                self._opened,
                counters,
                self._reconstruction,
            )

    def stop(self) -> None:
        """End the acquisition; the reconstruction goes on to refine. Asked again, it stops refining too."""
        with self._lock:
            role = "reconstruction" if self._state is CaptureState.FINISHING else "acquisition"
            child = self._children.get(role)
        if child is not None:
            child.stop()

    def dismiss(self) -> None:
        """Tell all workers to leave at once."""
        with self._lock:
            self._closing = True
            children = list(self._children.values())
        for child in children:
            child.dismiss()

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

    def _start(self, order: Order, on_exit: Callable[[str | None], None]) -> None:
        with self._lock:
            if self._closing:
                return
            role = order.role

            def ended(trouble: str | None) -> None:
                with self._lock:
                    self._children.pop(role, None)
                    on_exit(trouble)

            self._children[role] = Child(order, self.folder / f"{role}.log", self._hear, ended)

    def _hear(self, news: News) -> None:
        with self._lock:
            match news:
                case RingOpened():
                    self._attach(news)
                case ReconstructionStatus():
                    self._reconstruction = news
                case Refused():
                    self._note(news.reason)

    def _attach(self, opened: RingOpened) -> None:
        self._opened = opened
        self._ring = Ring.attach(opened.name)
        self._state = CaptureState.STREAMING
        order = ReconstructionOrder(
            ring=opened.name,
            folder=self.folder,
            unhurried=opened.unhurried,
            seed=self.plan.seed,
            steps=self.plan.steps,
            intrinsics=self.plan.intrinsics,
        )
        self._start(order, self._reconstruction_ended)
        self._start(PreviewOrder(ring=opened.name, file=self.preview), self._preview_ended)

    def _acquisition_ended(self, trouble: str | None) -> None:
        clean_stale()
        self._note(trouble)
        if self._state is CaptureState.STREAMING:
            self._state = CaptureState.FINISHING
        elif self._state is CaptureState.STARTING:
            self._state = CaptureState.FAILED if self._reason else CaptureState.COMPLETE

    def _reconstruction_ended(self, trouble: str | None) -> None:
        if self._closing:
            return
        self._note(trouble)
        self._state = CaptureState.FAILED if self._reason else CaptureState.COMPLETE
        for child in list(self._children.values()):
            child.dismiss()

    def _preview_ended(self, trouble: str | None) -> None:
        if trouble is None or self._closing or self._opened is None:
            return
        self._preview_deaths += 1
        again = self._preview_deaths <= _PREVIEW_RETRIES and self._state is CaptureState.STREAMING
        self._warnings.append(f"{trouble}; {'it was started again' if again else 'there is no live picture'}")
        if again:
            self._start(PreviewOrder(ring=self._opened.name, file=self.preview), self._preview_ended)

    def _note(self, trouble: str | None) -> None:
        """The first trouble is the reason that counts; after a dismissal, deaths are no news."""
        if trouble is not None and not self._closing and not self._reason:
            self._reason = trouble
