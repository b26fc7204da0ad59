"""Fault injection for any source: losses, stalls, damage and unplugging at exactly repeatable frames."""

import time
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.ring import DeviceState, DeviceStatus, End, Gap, LossCause
from spiked.sensor import Sensor
from spiked_driver.source import READ_WAIT_S, Chunk, Source, former_source_names

_NOISE_SHARE = 16
"""A damaged frame has noise in one of so many parts of its bytes."""


@dataclass(frozen=True)
class Loss:
    """Frames that are removed from the source's."""

    first: int
    count: int
    cause: LossCause = LossCause.USB
    unplugged: bool = False
    """The device state is `lost` during the loss."""


@dataclass(frozen=True)
class Stall:
    """A pause before a frame. The frames after it come late and are not lost."""

    frame: int
    seconds: float


@dataclass(frozen=True)
class Faults:
    """Faults to inject into a source."""

    losses: tuple[Loss, ...] = ()
    stalls: tuple[Stall, ...] = ()
    drop: float = 0.0
    """Fraction of the frames lost at random (cause usb)."""
    drop_run: int = 1
    """Frames per loss."""
    seed: int = 0
    corrupt: float = 0.0
    """Fraction of the frames delivered with noise in some pixels. Not detectable: the wire has no checksum of them."""

    def __post_init__(self) -> None:
        if not 0 <= self.drop < 1 or self.drop_run < 1:
            raise ConfigurationError(
                f"dropping a fraction of {self.drop:g}, {self.drop_run} frames each, is not possible"
            )
        if not 0 <= self.corrupt <= 1:
            raise ConfigurationError(f"corrupting a fraction of {self.corrupt:g} of the frames is not possible")
        if any(loss.first < 0 or loss.count < 1 for loss in self.losses):
            raise ConfigurationError("a loss must start at frame 0 or later and have at least one frame")
        if any(stall.frame < 0 or stall.seconds < 0 for stall in self.stalls):
            raise ConfigurationError("a stall must be at frame 0 or later and last 0 s or longer")
        for earlier, later in pairwise(sorted(self.losses, key=lambda loss: loss.first)):
            if earlier.first + earlier.count > later.first:
                raise ConfigurationError(f"losses overlap at frame {later.first}: give each frame to one of them")


@former_source_names
class FaultySource:
    """A source with injected faults. The inner source delivers all frames, so its timing and content do not change."""

    def __init__(self, inner: Source, faults: Faults) -> None:
        self.inner = inner
        self.faults = faults
        self._losses: deque[Loss] = deque()
        self._stalls: deque[Stall] = deque()
        self._pending: deque[Gap | End] = deque()
        self._loss: Loss | None = None  # the current one
        self._stalled_since_s: float | None = None
        self.corrupted = 0
        """Frames damaged since `open`."""
        self._restart()

    @property
    def sensor(self) -> Sensor:
        """The inner source's."""
        return self.inner.sensor

    @property
    def frames(self) -> int | None:
        """The inner source's: lost frames are counted."""
        return self.inner.frames

    @property
    def can_block(self) -> bool:
        """The inner source's."""
        return self.inner.can_block

    @property
    def device_status(self) -> DeviceStatus:
        """The inner source's, or lost during an injected unplugging."""
        if self._loss is not None and self._loss.unplugged:
            return DeviceStatus(DeviceState.LOST, "unplugged by fault injection")
        return self.inner.device_status

    def open(self) -> None:
        """Open the inner source and restart the faults."""
        self._restart()
        self.inner.open()

    def close(self) -> None:
        """Close the inner source."""
        self._loss = None
        self.inner.close()

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`."""
        if self._pending:
            return self._pending.popleft()
        if self._stalls and self._stalls[0].frame <= self._next:
            self._stall(self._stalls[0])
            return None
        if self._loss is None:
            self._loss = self._loss_at(self._next)
        if self._loss is not None:
            return self._lose(self._loss, view)
        item = self.inner.read_into(view[: self._undisturbed(len(view))])
        if isinstance(item, Chunk):
            self._corrupt(view[: item.frames])
        self._advance(item)
        return item

    def _restart(self) -> None:
        self._next = 0
        self._lost_first = 0
        self._losses = deque(sorted(self.faults.losses, key=lambda loss: loss.first))
        self._stalls = deque(sorted(self.faults.stalls, key=lambda stall: stall.frame))
        self._random = np.random.default_rng(self.faults.seed)
        self._next_drop = self._draw_drop()
        self._noise = np.random.default_rng([self.faults.seed, 1])
        self._next_corrupt = self._draw_corrupt(0)
        self.corrupted = 0
        self._loss = None
        self._pending.clear()
        self._stalled_since_s = None

    def _draw_drop(self) -> int | None:
        """First frame of the next random loss: a geometric number of frames ahead, whose mean gives the fraction."""
        if not self.faults.drop:
            return None
        chance = self.faults.drop / (self.faults.drop_run * (1 - self.faults.drop) + self.faults.drop)
        return self._next + int(self._random.geometric(chance)) - 1

    def _draw_corrupt(self, start: int) -> int | None:
        """The first damaged frame from `start` on."""
        return start + int(self._noise.geometric(self.faults.corrupt)) - 1 if self.faults.corrupt else None

    def _corrupt(self, frames: NDArray[np.uint8]) -> None:
        """Damage the selected ones of the frames, uint8 [n, frame_bytes], in place; the first has index `_next`."""
        while self._next_corrupt is not None and self._next_corrupt < self._next + len(frames):
            noise = self._noise.integers(0, 256, frames.shape[1] // _NOISE_SHARE + 1, np.uint8)
            at = int(self._noise.integers(0, frames.shape[1] - len(noise) + 1))
            if self._next_corrupt >= self._next:  # otherwise it was lost
                frames[self._next_corrupt - self._next, at : at + len(noise)] ^= noise
                self.corrupted += 1
            self._next_corrupt = self._draw_corrupt(self._next_corrupt + 1)

    def _loss_at(self, frame: int) -> Loss | None:
        while self._losses and self._losses[0].first + self._losses[0].count <= frame:
            self._losses.popleft()
        if self._losses and self._losses[0].first <= frame:
            loss = self._losses.popleft()
        elif self._next_drop is not None and self._next_drop <= frame:
            loss = Loss(frame, self.faults.drop_run)
        else:
            return None
        self._lost_first = frame
        return loss

    def _undisturbed(self, wanted: int) -> int:
        """Number of frames up to `wanted` that can be read before the next fault."""
        starts = [self._losses[0].first] if self._losses else []
        starts += [self._stalls[0].frame] if self._stalls else []
        starts += [self._next_drop] if self._next_drop is not None else []
        return min([wanted, *(start - self._next for start in starts)])

    def _lose(self, loss: Loss, view: NDArray[np.uint8]) -> Gap | End | None:
        """Discard frames of the inner source; return one gap when all frames of the loss have come.

        Makes one read per call, so that the caller sees the device state during the loss.
        """
        item = self.inner.read_into(view[: loss.first + loss.count - self._next])
        if isinstance(item, Chunk):
            self._advance(item)
            return self._end_loss(loss) if self._next == loss.first + loss.count else None
        return None if item is None else self._interrupted(loss, item)

    def _interrupted(self, loss: Loss, item: Gap | End) -> Gap | End:
        """The inner source returned a gap or the end: return it after the gap of the frames lost so far."""
        self._losses.appendleft(loss)  # it continues after the gap
        if self._next == self._lost_first:
            self._loss = None
            self._advance(item)
            return item
        lost = self._end_loss(loss)
        self._advance(item)
        self._pending.append(item)
        return lost

    def _end_loss(self, loss: Loss) -> Gap:
        gap = Gap(self._lost_first, self._next - self._lost_first, loss.cause)
        self._loss = None
        if self._next_drop is not None and self._next_drop < self._next:
            self._next_drop = self._draw_drop()
        return gap

    def _advance(self, item: Chunk | Gap | End | None) -> None:
        if isinstance(item, Chunk):
            self._next += item.frames
        elif isinstance(item, Gap):
            self._next += item.count

    def _stall(self, stall: Stall) -> None:
        now_s = time.monotonic()
        if self._stalled_since_s is None:
            self._stalled_since_s = now_s
        remaining_s = self._stalled_since_s + stall.seconds - now_s
        time.sleep(max(0.0, min(remaining_s, READ_WAIT_S)))
        if remaining_s <= READ_WAIT_S:
            self._stalls.popleft()
            self._stalled_since_s = None
