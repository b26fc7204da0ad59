"""Long paths: keyframes instead of a spline, and loops that close."""

import pickle
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import ArrayLike

from spiked.evaluate import score_trajectory
from spiked.pose import Array, exp_so3
from spiked.recon import Options, Reconstructor
from spiked.recon.frontend.feature_tracks import picture, white_of
from spiked.recon.mapping.pose_steps import GaussNewton
from spiked.recon.odometry import loop_closure
from spiked.recon.odometry.long_paths import LONG_FRAMES
from spiked.recon.odometry.loop_closure import LoopSearch, find_closures
from spiked.recon.odometry.odometry import Odometry
from spiked.recon.odometry.place_index import PlaceIndex
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.motion import HandShake, Stage, hand_shake
from spiked.simulate.room import Room
from spiked.spline import Waypoints
from spiked.trajectory import Trajectory

SENSOR = Sensor(160, 100, 20_000.0, intrinsics=Intrinsics.from_fov(160, 100, 60))
FRAMES = 20_000
TURN_RAD, WAY = 1.9, 0.25
"""How far the camera turns away, and how far it moves meanwhile, as a share of the depth."""


@dataclass(frozen=True)
class ThereAndBack:
    """To the side, turning away from what was seen first, and back again, with the tremor of a hand."""

    stage: Stage
    shake: HandShake
    frames: int = FRAMES

    def poses(self, frames: ArrayLike) -> tuple[Array, Array]:
        """See `Motion.poses`."""
        times = np.atleast_1d(np.asarray(frames, np.float64))
        share = np.sin(np.pi * times / self.frames) ** 2
        up = self.stage.up / np.linalg.norm(self.stage.up)
        turned, moved = self.shake.poses(times)
        side = self.stage.rotation[:, 0] * WAY * self.stage.depth
        return exp_so3(TURN_RAD * share[:, None] * up) @ turned, moved + share[:, None] * side


def follow(sensor: Sensor, options: Options) -> tuple[Reconstructor, Trajectory]:
    """All frames of a path there and back, tracked, and its truth."""
    assert sensor.intrinsics is not None
    stage = Room(colour=False, seed=2).stage(sensor.intrinsics, flow_px=0.02, parallax=0.01)
    camera = SimulatedCamera(sensor, seed=2, motion=ThereAndBack(stage, hand_shake(stage, seed=3)), step_px=0.3)
    reconstructor = Reconstructor(sensor, options)
    for first in range(0, FRAMES, 500):
        reconstructor.feed(first, camera.next_frames(500))
    rotations, centres = camera.truth(np.arange(FRAMES))
    return reconstructor, Trajectory((np.arange(FRAMES) + 0.5) / sensor.frame_rate_hz, rotations, centres)


@pytest.fixture(scope="module")
def fed() -> tuple[Reconstructor, Trajectory]:
    """See `follow`."""
    return follow(SENSOR, Options(steps=300))


@pytest.fixture(scope="module")
def not_ended(fed: tuple[Reconstructor, Trajectory]) -> Odometry:
    """The odometry before its end."""
    return deepcopy(fed[0].odometry)


@pytest.fixture(scope="module")
def walked(fed: tuple[Reconstructor, Trajectory], not_ended: Odometry) -> tuple[Reconstructor, Trajectory]:
    """The reconstruction with its last adjustment, and the truth."""
    del not_ended
    fed[0].odometry.end()
    return fed


def test_a_long_path_is_followed_and_its_loop_closed(walked: tuple[Reconstructor, Trajectory]) -> None:
    """0.9 % ATE; 1.4 without recovered tracks and warped templates, 3.2 as a spline."""
    reconstructor, truth = walked
    odometry = reconstructor.odometry
    assert odometry.sparse and odometry.views[-1].time - odometry.views[0].time > LONG_FRAMES
    score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=SENSOR.frame_rate_hz)
    assert score.coverage > 0.99
    assert score.errors.ate_percent < 1.8
    assert len(odometry.closures) >= 3
    seconds = FRAMES / SENSOR.frame_rate_hz
    assert all(0 < earlier < later < seconds for earlier, later in reconstructor.closures())
    told = reconstructor.report()["closures"]
    assert isinstance(told, list) and len(told) == len(odometry.closures)


def test_views_know_how_lengths_around_them_have_grown(
    not_ended: Odometry, walked: tuple[Reconstructor, Trajectory]
) -> None:
    """By the depths of the points that they see, before the last adjustments and after them."""
    before, after = not_ended.map, walked[0].odometry.map
    known = np.isfinite(before.points[:, 0]) & np.isfinite(after.points[: len(before.points), 0])
    grown, told = [], []
    for old, new in zip(before.views, after.views, strict=False):
        ids = old.ids[known[old.ids]]
        if old.pose is None or new.pose is None or len(ids) < 20:
            continue
        depths = ((m.points[ids] - v.pose.centre) @ v.pose.rotation[:, 2] for m, v in ((before, old), (after, new)))
        first, last = depths
        good = (first > 0) & (last > 0)
        grown.append(float(np.median(last[good] / first[good])))
        told.append(new.scale / old.scale)
    errors = np.abs(np.log(np.array(told) / grown))
    assert len(grown) > 100 and np.ptp(grown) > 0.005
    assert np.median(errors) < 0.3 * np.ptp(np.log(grown)) and np.percentile(errors, 95) < 0.02


def test_loops_are_closed_while_it_runs(not_ended: Odometry, walked: tuple[Reconstructor, Trajectory]) -> None:
    """The camera is back half-way between the turn and the end; what is closed later is closed at once as well."""
    assert len(not_ended.closures) >= 3
    assert walked[0].odometry.closures[: len(not_ended.closures)] == not_ended.closures
    assert all(later - earlier > FRAMES / 4 for earlier, later in not_ended.closures)


@pytest.mark.parametrize("found", [True, False])
def test_a_place_that_is_seen_again_is_not_kept_twice(
    not_ended: Odometry, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Places grow with what the camera sees and not with time."""
    views, pictures = not_ended.views, not_ended.keyframe_images
    kept = sorted(pictures)
    search = LoopSearch(not_ended.map, pictures, PlaceIndex(not_ended.map))
    search.add_kept(views[number] for number in kept[: len(kept) // 2])
    numbers, places = len(search.index.numbers), len(search.index.places)
    monkeypatch.setattr(loop_closure, "find_by_path", lambda *_, **__: object() if found else None)
    monkeypatch.setattr(LoopSearch, "_confirmed", lambda *_: [])
    for number in kept[len(kept) // 2 :]:
        assert search.search(views[number]) == []
    assert len(search.index.numbers) > numbers + 5
    assert (len(search.index.places) == places) == found


def test_a_checkpoint_writes_the_features_of_places_once(not_ended: Odometry) -> None:
    """They are most of what grows with the path: pickled each time, they took much of the tracking of a minute."""
    assert not_ended._keyframes is not None
    index, once = not_ended._keyframes.loops.index, {id(array) for array in not_ended.fixed_arrays()}
    for place in index.places:
        assert {id(place.features.pixels), id(place.features.descriptors), id(place.tracks)} <= once
    assert index._retrieval is not None
    anew = sum(len(pickle.dumps(array)) for array in vars(index._retrieval).values() if isinstance(array, np.ndarray))
    assert len(pickle.dumps(index._retrieval)) - anew > 1e5 > anew, "what is written once, and each time"
    back = pickle.loads(pickle.dumps(index._retrieval))
    query = index.places[3].features
    assert np.array_equal(back.votes(query), index._retrieval.votes(query))


def test_the_trajectory_so_far_has_the_poses_of_the_views(walked: tuple[Reconstructor, Trajectory]) -> None:
    """Until the tracking has ended; what it has is in the trajectory of all frames as well."""
    reconstructor, _ = walked
    assert not reconstructor.tracking_ended
    whole, so_far = reconstructor.trajectory(), reconstructor.trajectory_so_far()
    assert len(whole) == reconstructor.posed_frames > 0.99 * FRAMES
    assert 100 < len(so_far) == sum(view.posed for view in reconstructor.views.since(0)) < len(whole) / 10
    before = np.searchsorted(whole.times_s, so_far.times_s) - 1
    steps = np.linalg.norm(whole.centres[before] - so_far.centres, axis=1)
    assert np.median(steps) < 2 * np.median(np.linalg.norm(np.diff(whole.centres, axis=0), axis=1))


def test_tracks_that_ended_are_found_again(walked: tuple[Reconstructor, Trajectory]) -> None:
    """Between a break of a few views and the return after a loop there is nothing else that resumes a track."""
    views = walked[0].odometry.views
    ids = np.concatenate([view.ids for view in views])
    numbers = np.repeat([view.id for view in views], [len(view.ids) for view in views])
    order = np.lexsort((numbers, ids))
    breaks = np.diff(numbers[order])[np.diff(ids[order]) == 0]
    assert ((breaks > 3) & (breaks < 60)).sum() > 100


@pytest.mark.parametrize("asked", [0, 1, 3])
def test_the_last_adjustment_ends_when_it_is_told(
    walked: tuple[Reconstructor, Trajectory], not_ended: Odometry, asked: int
) -> None:
    """A whole one asks more often; every view keeps a pose, whenever it ends."""
    odometry = deepcopy(not_ended)
    calls = []

    def stop() -> bool:
        calls.append(0)
        return len(calls) > asked

    odometry.end(stop)
    assert asked < len(calls) < asked + 25  # each step that is refused raises the damping
    assert sum(view.pose is not None for view in odometry.views) == sum(
        view.pose is not None for view in walked[0].odometry.views
    )
    assert odometry.closures[: len(not_ended.closures)] == not_ended.closures


def test_a_copy_ends_like_the_original(walked: tuple[Reconstructor, Trajectory], not_ended: Odometry) -> None:
    """Also where it is taken while all keyframes are adjusted on another thread."""
    copy = deepcopy(not_ended)
    copy.end()
    ends = [view.centre for view in (walked[0].odometry.views[-1], copy.views[-1])]
    assert ends[0] is not None and ends[1] is not None and (ends[0] == ends[1]).all()


def test_a_copy_of_the_last_adjustment_ends_like_it(
    walked: tuple[Reconstructor, Trajectory], not_ended: Odometry
) -> None:
    """One between closing loops and the last rounds, and one before the very last."""
    odometry, copies = deepcopy(not_ended), list[Odometry]()
    odometry.end(save=lambda: copies.append(deepcopy(odometry)))
    assert len(copies) > 3
    for copy in (copies[0], copies[-2]):
        rounds = list[None]()
        copy.end(save=lambda: rounds.append(None))  # noqa: B023
        assert 0 < len(rounds) < len(copies)
        for mine, theirs in zip(copy.views, walked[0].odometry.views, strict=True):
            assert mine.centre is not None and theirs.centre is not None
            assert (mine.centre == theirs.centre).all()


def test_a_short_refinement_keeps_a_path_that_is_interpolated(walked: tuple[Reconstructor, Trajectory]) -> None:
    """1.42 to 1.57 % ATE: 300 steps on small images do not improve it (1.39 and 1.49 with other seeds)."""
    reconstructor, truth = walked
    before = _ate_percent(reconstructor, truth)
    reconstructor.finish()
    after = _ate_percent(reconstructor, truth)
    assert after != before and after < 1.2 * before


@pytest.mark.slow
def test_the_map_corrects_a_path_that_is_interpolated() -> None:
    """0.815 to 0.751 % ATE with the default steps; the walk of docs/accuracy.md gains a fifth."""
    reconstructor, truth = follow(Sensor(240, 150, 20_000.0, intrinsics=Intrinsics.from_fov(240, 150, 60)), Options())
    reconstructor.odometry.end()
    before = _ate_percent(reconstructor, truth)
    reconstructor.finish()
    assert _ate_percent(reconstructor, truth) < 0.97 * before


def test_an_alignment_of_many_views_takes_some_of_them(
    walked: tuple[Reconstructor, Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its matrix grows with the square of the views: what it corrects is interpolated between those it takes."""
    monkeypatch.setattr("spiked.recon.mapping.pose_steps.LONG_ALIGNED_VIEWS", 20)
    trainer, path = walked[0].trainer, walked[0].path
    assert isinstance(path, Waypoints)
    ids = trainer.views.mappable(path)
    corrected = GaussNewton(trainer).improve(path, ids, 1, 0.7)
    assert isinstance(corrected, Waypoints)
    taken = [trainer.views[i].time for i in trainer.views.spread(ids, 20)]
    assert len(taken) == 20 < len(ids)
    moved = corrected.centres - path.centres
    at = np.searchsorted(path.times, taken)
    between = np.stack([np.interp(path.times, taken, one) for one in moved[at].T], 1)
    np.testing.assert_allclose(moved, between, atol=1e-9)
    assert np.abs(moved).max() > 1e-6


def _ate_percent(reconstructor: Reconstructor, truth: Trajectory) -> float:
    estimate = reconstructor.trajectory()
    score = score_trajectory(truth=truth, estimate=estimate, frame_rate_hz=SENSOR.frame_rate_hz)
    return score.errors.ate_percent


def test_no_loop_is_closed_between_different_places(walked: tuple[Reconstructor, Trajectory]) -> None:
    """Images of another room in the place of the later ones: the path says that they should match."""
    reconstructor, _ = walked
    sparse_map, pictures = reconstructor.odometry.map, reconstructor.odometry.keyframe_images
    assert SENSOR.intrinsics is not None
    other = Room(colour=False, seed=77)
    travelled = np.cumsum([view.motion_px for view in sparse_map.views])
    foreign, late = dict(pictures), travelled > travelled[-1] / 2
    known = max(int(view.ids.max()) for view in sparse_map.views if not late[view.id])
    for view in sparse_map.views:
        if late[view.id]:  # the loop is open again: later views have tracks of their own only
            own = view.ids > known
            view.ids, view.pixels = view.ids[own], view.pixels[own]
    for number in pictures:
        view = sparse_map.views[number]
        if late[number] and view.pose is not None:
            stage = other.stage(SENSOR.intrinsics)
            seen = other.render(
                SENSOR.intrinsics, SENSOR.width, SENSOR.height, stage.rotation @ view.pose.rotation, stage.centre
            )
            grey = np.ascontiguousarray(seen.intensity[..., 0], np.float32)
            foreign[number] = picture(grey, white_of(grey))
    index = LoopSearch.of(sparse_map, pictures).index
    assert find_closures(sparse_map, foreign, index) == []
    assert find_closures(sparse_map, pictures, index) != []
