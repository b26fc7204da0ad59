"""The bytes of endpoint 0x82: frames with headers, counters and row tags, at a rate or as fast as they are taken."""

import heapq
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .faults import Fault, Kind

ROWS, ROW_BYTES = 250, 50
COMPACT_BYTES = ROWS * ROW_BYTES
FRAME_BYTES = 16 + ROWS * (ROW_BYTES + 2)
MAGIC, WORD1 = 0x63606300, 0x00100021
STAMP_BYTES = 8
_TRANSFERS_KEPT = 4096


@dataclass(frozen=True)
class Run:
    """Frames that were sent one after another."""

    first: int
    count: int


def wire_frames(frames: NDArray[np.uint8], magic: int = MAGIC) -> NDArray[np.uint8]:
    """Compact frames, uint8 [n, 12500], as they are on the wire, uint8 [n, 13016], with both counters 0."""
    wire = np.zeros((len(frames), FRAME_BYTES), np.uint8)
    wire[:, :8] = np.array([magic, WORD1], "<u4").view(np.uint8)
    lines = wire[:, 16:].reshape(len(frames), ROWS, ROW_BYTES + 2)
    lines[:, :, :ROW_BYTES] = frames.reshape(len(frames), ROWS, ROW_BYTES)
    lines[:, :, ROW_BYTES:] = np.arange(ROWS, dtype="<u2").view(np.uint8).reshape(ROWS, 2)
    return wire


class Stream:
    """An endless camera that plays its pictures over and over.

    With a rate it free-runs by the clock, whether it is read or not: what finds no room at the host in time is dropped
    in whole frames and counted. What the host has room for is sent by the clock even if this process is late: a camera
    is not slowed down by a busy machine. Without a rate (0) there is always a next frame and none is dropped. With
    `stamp` the first 8 bytes of pixels are the frame's number, so that no two frames are the same.

    What is kept of frames without room is the newest `buffer_frames`, or with `fifo` the oldest, as in the real camera:
    then old frames come first, and the count jumps behind them.
    """

    def __init__(
        self,
        frames: NDArray[np.uint8],
        *,
        rate_hz: float = 0.0,
        lines: int = 0,
        nbytes: int = 0,
        buffer_frames: int = 64,
        stamp: bool = True,
        fifo: bool = False,
        magic: int = MAGIC,
        faults: tuple[Fault, ...] = (),
    ) -> None:
        self._wire = wire_frames(frames, magic)
        self._words = self._wire[:, :16].view("<u4")
        self._rate_hz = rate_hz
        self._lines, self._nbytes = lines, nbytes
        self._buffer_frames = buffer_frames
        self._stamp = stamp
        self._fifo = fifo
        self._room_since_s = 0.0
        self._kept_to = 0  # the first frame that is not yet in the buffer, or dropped
        self._faults: list[Fault] = list(faults)
        heapq.heapify(self._faults)
        self.start_s = time.monotonic()
        """With a rate, frame k is there 1 + k frames later."""
        self._silent_until_s = 0.0
        self._pieces: list[memoryview] = []
        self._breaks: list[Fault | None] = []
        """With each piece: what happens behind it."""
        self.next_frame = 0
        self.sent: list[Run] = []
        self.dropped = 0
        """Frames that the host did not take in time."""
        self.done: list[Fault] = []
        self.handed_over: deque[tuple[int, float]] = deque(maxlen=_TRANSFERS_KEPT)
        """For the last transfers that were full: the frame in which each ends, and the monotonic time at which the host
        had it."""

    def add(self, fault: Fault) -> None:
        """One more fault; at a frame that has gone by: now."""
        heapq.heappush(self._faults, fault)

    def power_on(self, lines: int, nbytes: int) -> None:
        """Start anew with the counters at these values for the next frame; what was in the buffer is gone."""
        self._pieces.clear()
        self._breaks.clear()
        self._skip_missed(self._due(time.monotonic()))
        self._lines = lines - ROWS * self.next_frame
        self._nbytes = nbytes - COMPACT_BYTES * self.next_frame

    def wait_s(self, now_s: float, wanted_bytes: int = 1) -> float:
        """How long until there are so many bytes to send, if nothing goes wrong meanwhile."""
        wanted_bytes -= sum(map(len, self._pieces))
        if wanted_bytes <= 0:
            return 0.0
        wait_s = self._silent_until_s - now_s
        if self._rate_hz:
            frames = -(-wanted_bytes // FRAME_BYTES)
            wait_s = max(wait_s, self.start_s + (self.next_frame + frames) / self._rate_hz - now_s)
        return max(0.0, wait_s)

    def _due(self, time_s: float) -> int:
        """Frames that were taken by then."""
        return int((time_s - self.start_s) * self._rate_hz)

    def pull(self, limit: int, now_s: float, room_since_s: float) -> tuple[list[memoryview], Fault | None]:
        """The next bytes, `limit` at most, and what happens then. They are valid until the next call.

        Since `room_since_s` the host has had room for what the camera sends.
        """
        taken: list[memoryview] = []
        while limit > 0:
            if not self._pieces and not self._compose(limit, now_s, room_since_s):
                break
            piece, happens = self._pieces[0], self._breaks[0]
            if len(piece) > limit:
                taken.append(piece[:limit])
                self._pieces[0] = piece[limit:]
                break
            if len(piece):
                taken.append(piece)
                limit -= len(piece)
            del self._pieces[0], self._breaks[0]
            if happens is not None:
                return taken, happens
        return taken, None

    def _compose(self, wanted_bytes: int, now_s: float, room_since_s: float) -> bool:
        """Put the next frames in front, up to the next fault; false if none is due."""
        if self.wait_s(now_s) > 0:
            return False
        if self._fifo:
            self._fill_buffer(room_since_s)
        else:
            self._skip_missed(self._due(room_since_s) - self._buffer_frames)
        while self._faults and self._faults[0].frame <= self.next_frame:
            if not self._misbehave(heapq.heappop(self._faults), now_s):
                return bool(self._pieces)
        count = -(-wanted_bytes // FRAME_BYTES)
        if self._rate_hz:
            count = min(count, self._due(now_s) - self.next_frame)
        if self._faults:
            count = min(count, self._faults[0].frame - self.next_frame)
        self._push(self._frames(max(1, count)).reshape(-1))
        return True

    def _frames(self, count: int) -> NDArray[np.uint8]:
        """The next frames, fewer where the pictures begin again, uint8 [n, 13016]."""
        at = self.next_frame % len(self._wire)
        count = min(count, len(self._wire) - at)
        index = np.arange(self.next_frame, self.next_frame + count, dtype=np.int64)
        words = self._words[at : at + count]
        words[:, 2] = (self._nbytes + COMPACT_BYTES * index) & 0xFFFFFFFF
        words[:, 3] = (self._lines + ROWS * index) & 0xFFFFFFFF
        wire = self._wire[at : at + count]
        if self._stamp:
            wire[:, 16 : 16 + STAMP_BYTES] = index.astype("<i8").view(np.uint8).reshape(count, STAMP_BYTES)
        if self.sent and self.sent[-1].first + self.sent[-1].count == self.next_frame:
            self.sent[-1] = Run(self.sent[-1].first, self.sent[-1].count + count)
        else:
            self.sent.append(Run(self.next_frame, count))
        self.next_frame += count
        return wire

    def _push(self, data: NDArray[np.uint8], happens: Fault | None = None) -> None:
        self._pieces.append(memoryview(data))  # type: ignore[arg-type]
        self._breaks.append(happens)

    def _skip_missed(self, oldest: int) -> None:
        """Go on with this frame, if there is a clock and the camera has not sent it already."""
        if self._rate_hz and oldest > self.next_frame:
            self.dropped += oldest - self.next_frame
            self.next_frame = oldest

    def _fill_buffer(self, room_since_s: float) -> None:
        """What came without room, up to when there was some again: kept as far as the buffer goes, else dropped."""
        if not self._rate_hz or room_since_s == self._room_since_s:
            return
        self._room_since_s = room_since_s
        kept_to = max(self._kept_to, self.next_frame)
        drops = sum(fault.count for fault in self._faults if fault.kind is Kind.DROP and fault.frame <= kept_to)
        free = self._buffer_frames - (kept_to - drops - self.next_frame)
        came = max(0, self._due(room_since_s) - kept_to)
        missed = max(0, came - free)
        if missed:
            self.dropped += missed
            self.add(Fault(kept_to + came - missed, Kind.DROP, count=missed))
        self._kept_to = kept_to + came

    def _misbehave(self, fault: Fault, now_s: float) -> bool:
        """Put what is wrong in front of the next frame; false if nothing may follow for now."""
        self.done.append(fault)
        match fault.kind:
            case Kind.DROP:
                self.next_frame += fault.count
            case Kind.REPEAT:
                again = self._frames(1).copy()
                for _ in range(1 + fault.count):
                    self._push(again.reshape(-1))
            case Kind.FLIP:
                spoilt = self._frames(1).reshape(-1).copy()
                spoilt[fault.offset] ^= fault.count
                self._push(spoilt)
            case Kind.LOSE:
                whole = self._frames(1).reshape(-1).copy()
                self._push(np.delete(whole, slice(fault.offset, fault.offset + fault.count)))
            case Kind.JUNK:
                self._push(np.random.default_rng(fault.frame).integers(0, 256, fault.count, np.uint8))
            case Kind.CUT:
                whole = self._frames(1).reshape(-1).copy()
                self._push(whole[: fault.offset], fault)
                self._push(whole[fault.offset :])
            case Kind.SILENCE:
                self._silent_until_s = now_s + fault.seconds
                if self._rate_hz:
                    self.next_frame = max(self.next_frame, self._due(self._silent_until_s))
                return False
            case Kind.RESTART:
                self.power_on(fault.offset, fault.count)
            case Kind.STALL | Kind.BABBLE | Kind.UNPLUG:
                self._push(np.empty(0, np.uint8), fault)
                return False
        return True
