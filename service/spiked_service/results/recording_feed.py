"""Feeds a whole recording to a reconstructor."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from spiked.recon import Reconstructor, Status
from spiked.recording import Recording

CHUNK_FRAMES = 64
"""Frames fed at a time."""


@dataclass(frozen=True)
class Piece:
    """Stored frames `first` to `first + count - 1`; the first one was captured as frame `index`."""

    first: int
    count: int
    index: int


def pieces(recording: Recording, chunk: int = CHUNK_FRAMES, begin: int = 0) -> Iterator[Piece]:
    """The stored frames in pieces of at most `chunk` frames without gaps.

    `begin` leaves out those captured before: the index after one of the pieces.
    """
    first = 0
    while first < recording.frames:
        index = recording.capture_index(first)
        later = (gap.first - index for gap in recording.gaps if gap.first > index)
        count = min(chunk, recording.frames - first, *later)
        if index >= begin:
            yield Piece(first, count, index)
        first += count


def reconstruct_recording(
    recording: Recording,
    reconstructor: Reconstructor,
    *,
    progress: Callable[[Status], None],
    cancelled: Callable[[], bool],
    budget_s: float | None = None,
    save: Callable[[], None] = lambda: None,
) -> None:
    """Feed every frame and gap, then refine, within `budget_s` seconds if given; stops early when cancelled.

    After an early stop the reconstructor holds the result so far. One from a checkpoint goes on. `save` is called
    wherever a checkpoint can be taken.
    """
    deadline = math.inf if budget_s is None else time.monotonic() + budget_s
    reconstructor.expect(recording.capture_index(recording.frames - 1) + 1)
    expected = reconstructor.frames
    for piece in pieces(recording, begin=expected):
        save()
        if cancelled() or time.monotonic() > deadline:
            break
        if piece.index > expected:
            reconstructor.gap(expected, piece.index - expected)
        reconstructor.feed(piece.index, recording.read(piece.first, piece.count))
        expected = piece.index + piece.count
        progress(reconstructor.status())
    reconstructor.finish(progress, cancelled, deadline - time.monotonic(), save)
