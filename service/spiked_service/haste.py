"""What is tracked of a camera that is faster than the tracker: less of it, rather than all of it too late."""

from spiked.recon.views import MARGIN

_LATE_S = 0.025
"""Up to here all is tracked: a block and a view take that long."""
_STRIDE = 12
"""Lengths of a view from one that is tracked to the next, while it is late. The tracker chooses the length by the
motion, so that the image moves by about a pixel in it; with a dozen pixels from view to view tracks still hold."""
_SHORTEST = 8
_OLD_S = 0.1
"""Beyond this the newest is tracked next, however far the image has moved: a pose so old is of no use to anybody."""


class Haste:
    """Chooses frames. While the tracker is late it gets enough for a view, and what comes up to the next is skipped.

    Nothing is lost by it: all frames are recorded, and a reconstruction from the recording takes all.
    """

    def __init__(self, rate_hz: float) -> None:
        self._late_frames = _LATE_S * rate_hz
        self._old_frames = _OLD_S * rate_hz
        self._begin: int | None = None
        self._resume = 0
        self.skipped = 0
        """Frames left out so far."""

    def wants(self, first: int, count: int) -> bool:
        """Whether these frames, which came after all others, are to be tracked."""
        if first < self._resume:
            self.skipped += count
            return False
        if self._begin is None:
            self._begin = first
        return True

    def fed(self, end: int, views: int, late_frames: int) -> None:
        """Frames up to `end` were tracked, which made so many views, and the camera is this much further."""
        if not views or self._begin is None:
            return
        took, self._begin = end - self._begin, None
        if late_frames > self._late_frames:
            # A view takes its own frames, and those behind it in which its last spikes end.
            length = max(_SHORTEST, (took - MARGIN) // views)
            self._resume = end + max(0, _STRIDE * length - took)
        if late_frames > self._old_frames:
            self._resume = max(self._resume, end + late_frames)
