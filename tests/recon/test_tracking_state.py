"""The history of states has one entry for each change, not for each figure."""

from spiked.recon import State
from spiked.recon.odometry.tracking_state import TrackingState


def test_a_reason_that_differs_in_figures_only_is_no_change() -> None:
    status = TrackingState()
    status.set(8.0, State.DEGRADED, "20 known points in view, 41% agree with one pose")
    status.set(16.0, State.DEGRADED, "22 known points in view, 40% agree with one pose")
    assert status.reason.startswith("22") and [time for time, _, _ in status.changes] == [8.0]
    status.set(24.0, State.DEGRADED, "the pose is only known to 1.2 px")
    status.set(32.0, State.LOST, "the pose is only known to 1.2 px")
    assert [time for time, _, _ in status.changes] == [8.0, 24.0, 32.0]


def test_a_sound_view_ends_a_doubt_and_is_no_change_while_tracking() -> None:
    status = TrackingState(State.TRACK, "bootstrap from 10 views")
    status.assess(8.0, None)
    assert status.changes == [] and status.reason == "bootstrap from 10 views"
    status.assess(16.0, "points lie 2.1 times as far off as their noise explains")
    status.assess(24.0, None)
    assert [(time, state) for time, state, _ in status.changes] == [(16.0, State.DEGRADED), (24.0, State.TRACK)]


def test_an_explanation_is_no_change() -> None:
    status = TrackingState()
    status.explain("3 of 10 views for a first map")
    assert status.state is State.BOOT and status.reason.startswith("3 of") and status.changes == []
