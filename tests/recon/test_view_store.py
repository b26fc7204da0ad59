"""The store of views: one record each, and images of some."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.recon.frontend.recorded_views import RecordedViews
from spiked.recon.frontend.windowing import View, make_view
from spiked.recon.odometry.sparse_map import Pose, TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.recon.view_store import ViewStore
from spiked.sensor import Sensor
from spiked.spline import Waypoints

LENGTH = 10
SENSOR = Sensor(8, 4, 20_000.0)


def view(number: int) -> View:
    """Ten frames with half a spike a frame."""
    frames = np.tile(np.uint8([[0xFF], [0x00]]), (LENGTH, SENSOR.height))
    begin = LENGTH * number
    window = aligned_window(frames, SENSOR, begin - LENGTH // 2, begin, begin + LENGTH)
    return make_view(window, SENSOR, after_gap=False)


class Frames:
    """A recording of half a spike a frame; frames from `end` on are not written yet."""

    def __init__(self, end: int) -> None:
        self.end = end
        self.frames = np.tile(np.uint8([[0xFF], [0x00]]), (end // 2 + LENGTH, SENSOR.height))

    def captured(self, first: int, count: int) -> NDArray[np.uint8] | None:
        """See `RecordedFrames`."""
        begin = first + LENGTH // 2  # that many frames before the first view
        return self.frames[begin : begin + count] if first + count <= self.end else None


def tracked(number: int, posed: bool = True, state: State = State.TRACK) -> TrackedView:
    time, ids, pixels = LENGTH * (number + 0.5), np.zeros(0, np.int64), np.zeros((0, 2))
    pose = Pose(np.eye(3), np.array([float(number), 0, 0])) if posed else None
    return TrackedView(number, time, LENGTH, ids, pixels, motion_px=1.0, state=state, pose=pose)


def store(count: int, most: int = 100, lost: tuple[int, ...] = (), bridged: tuple[int, ...] = ()) -> ViewStore:
    made = ViewStore(most)
    for number in range(count):
        known = number not in lost
        record = made.add(view(number), tracked(number, known, State.TRACK if known else State.LOST), number in bridged)
        made.thin()
        assert record.id == number
    return made


def path(count: int) -> Waypoints:
    times = LENGTH * (np.arange(count) + 0.5)
    return Waypoints(times, np.repeat(np.eye(3)[None], count, 0), np.zeros((count, 3)))


def test_a_view_keeps_its_id_when_images_of_others_are_dropped() -> None:
    views = store(21, most=20)
    assert views.kept == [0, 2, 4, 6, 8, *range(10, 21)]
    assert len(views) == 21 and 3 not in views.kept
    assert [views.image(i).begin for i in views.kept] == [LENGTH * i for i in views.kept]
    assert [record.id for record in views.since(19)] == [19, 20]
    with pytest.raises(AssertionError, match="view 3 was dropped"):
        views.image(3)


def test_images_stay_within_their_limit() -> None:
    views = store(200, most=20)
    assert len(views.kept) <= 20 and len(views) == 200
    assert views.kept[-5:] == list(range(195, 200))


def test_images_beyond_the_memory_are_built_anew() -> None:
    most_bytes = 30 * view(0).nbytes
    views = ViewStore(100, most_bytes, RecordedViews(Frames(80 * LENGTH), SENSOR))
    first = [view(number) for number in range(100)]
    for number in range(100):
        views.add(first[number], tracked(number))
        assert not views.thin()
    assert len(views.kept) == 100 and views.held_bytes <= most_bytes
    for number in (*range(80), *range(40)):
        again = views.image(number)
        assert (again.begin, again.end) == (first[number].begin, first[number].end)
        np.testing.assert_array_equal(again.rate, first[number].rate)
        assert views.held_bytes <= most_bytes


def test_images_that_cannot_be_built_anew_are_thinned_out() -> None:
    views = ViewStore(100, 30 * view(0).nbytes)
    for number in range(100):
        views.add(view(number), tracked(number))
        views.thin()
    assert views.held_bytes <= 30 * view(0).nbytes
    assert len(views.kept) <= 30 and views.kept[-5:] == list(range(95, 100))
    assert all(views.image(number).begin == LENGTH * number for number in views.kept)


def test_an_image_that_is_used_takes_no_more_memory() -> None:
    views = store(3)
    before = views.held_bytes
    assert views.image(1).light and "light" not in vars(views.image(1))
    assert views.held_bytes == before


def test_the_kept_images_are_spread_over_the_path() -> None:
    views = ViewStore(20)
    for number in range(400):  # it stands still between 100 and 300
        views.add(view(number), replace(tracked(number), motion_px=0.001 if 100 <= number < 300 else 1.0))
        views.thin()
    standing = [number for number in views.kept if 100 <= number < 300]
    assert views.kept[0] == 0 and len(standing) <= 2
    moving = [number if number < 100 else number - 200 for number in views.kept if number not in standing]
    assert max(np.diff(moving)) < 40  # 200 px of motion, 15 to 20 images


def test_the_map_gets_views_with_an_image_and_a_pose_inside_the_path() -> None:
    views = store(21, most=20, lost=(4, 12))
    assert views.mappable(None) == []
    assert views.mappable(path(18)) == [i for i in views.kept if i < 18 and i not in (4, 12)]


def test_the_path_is_known_near_posed_views_only() -> None:
    views = store(8, lost=(3, 4, 5))
    covered = views.covered(np.arange(0.5, 8 * LENGTH))
    assert covered[: 3 * LENGTH].all() and covered[6 * LENGTH :].all()
    assert not covered[3 * LENGTH : 6 * LENGTH].any()


def test_the_path_is_known_between_bridged_views() -> None:
    def far_apart(bridged: bool) -> ViewStore:
        made = ViewStore(100)
        for number in (0, 20):
            made.add(view(number), replace(tracked(number), id=len(made)), bridged and number > 0)
        return made

    middle = np.array([10.0 * LENGTH])
    assert far_apart(bridged=True).covered(middle).all()
    assert not far_apart(bridged=False).covered(middle).any()


def test_a_time_has_a_nearest_view_with_an_image() -> None:
    assert ViewStore(20).nearest(0.0) is None
    views = store(21, most=20)
    assert views.nearest(3.6 * LENGTH) == 4
    assert views[4].rate == pytest.approx(0.5)
