"""A tracker that is late gets a view's frames now and then; one that is not gets all."""

from spiked_service.haste import Haste

from spiked.recon.views import MARGIN

BLOCK = 8


def fed(haste: Haste, frames: int, length: int, late_frames: int) -> list[int]:
    """Which blocks were wanted, for a tracker that makes a view of so many frames and their margin."""
    wanted, in_hand, last = [], 0, -BLOCK
    for first in range(0, frames, BLOCK):
        if not haste.wants(first, BLOCK):
            continue
        in_hand = in_hand + BLOCK if first == last + BLOCK else BLOCK
        wanted.append(first)
        last = first
        views = int(in_hand >= length + MARGIN)
        haste.fed(first + BLOCK, views, late_frames)
        in_hand -= length * views
    return wanted


def test_all_is_tracked_in_time() -> None:
    haste = Haste(20_000.0)
    assert fed(haste, 4000, 32, late_frames=400) == list(range(0, 4000, BLOCK))
    assert haste.skipped == 0


def test_a_late_tracker_gets_one_view_in_twelve() -> None:
    haste = Haste(20_000.0)
    wanted = fed(haste, 384 * 10, 32, late_frames=3000)
    assert wanted[: (32 + MARGIN) // BLOCK] == list(range(0, 32 + MARGIN, BLOCK))
    assert wanted[(32 + MARGIN) // BLOCK] == 12 * 32
    assert len(wanted) == 10 * (32 + MARGIN) // BLOCK
    assert haste.skipped == 384 * 10 - len(wanted) * BLOCK
