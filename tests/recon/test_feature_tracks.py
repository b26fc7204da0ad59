"""Compiled tracks and pictures against what they are meant to be, written plainly."""

import cv2
import numpy as np
import pytest
import spiked.native._bundle as _bundle
import spiked.native._geometry as _geometry

from spiked.blocks import Window, aligned_window
from spiked.pose import exp_so3
from spiked.recon.frontend.feature_tracks import Tracks, flow, picture, pyramid, white_of
from spiked.recon.frontend.spike_intervals import JITTER, SpikeIntervals
from spiked.recon.frontend.windowing import make_view
from spiked.recon.statistics import median
from spiked.sensor import Sensor

H, W = 96, 128


def scene(shift: tuple[float, float], seed: int = 0) -> np.ndarray:
    """Smooth random rates [H, W] whose content is moved by (x, y) px."""
    rough = np.random.default_rng(seed).random((H + 80, W + 80))
    down, across = np.fft.fftfreq(H + 80)[:, None], np.fft.fftfreq(W + 80)
    blur = np.exp(-0.5 * (2 * np.pi * 2.0) ** 2 * (down**2 + across**2))
    moved = np.exp(-2j * np.pi * (shift[0] * across + shift[1] * down))
    smooth = np.fft.ifft2(np.fft.fft2(rough - 0.5) * blur * moved).real
    return np.clip(0.5 + 4 * smooth[40:-40, 40:-40], 0, 1).astype(np.float32)


@pytest.mark.parametrize("shift", [(0.3, -0.2), (1.7, 2.4), (-9.0, 6.0)])
def test_places_are_found_to_a_fiftieth_of_a_pixel(shift: tuple[float, float]) -> None:
    a, b = (picture(scene(s), 1.0) for s in ((0.0, 0.0), shift))
    y, x = np.mgrid[22 : H - 22 : 8, 24 : W - 24 : 8] + 0.5
    start = np.stack([x.ravel(), y.ravel()], 1)
    found, good = flow(a, b, start, start, 0.6, levels=3)
    assert good.mean() > 0.9
    error = np.linalg.norm(found - start - shift, axis=1)[good]
    assert np.median(error) < 0.02 and np.percentile(error, 95) < 0.05


def errors_of_both(a: np.ndarray, b: np.ndarray, motion: np.ndarray) -> tuple[float, float]:
    """Median distance in px from where the affine `motion` [2, 3] of pixel centres leads, of ours and of OpenCV's."""
    corners = cv2.goodFeaturesToTrack(a[16:-16, 16:-16].copy(), 100, 0.01, 7)[:, 0].astype(float) + 16
    truth = corners @ motion[:, :2].T + motion[:, 2]
    found, good = flow(a, b, corners + 0.5, corners + 0.5, 0.6, levels=2)
    p = corners.astype(np.float32)[:, None]
    there, ok, _ = cv2.calcOpticalFlowPyrLK(a, b, p, None, winSize=(13, 13), maxLevel=2)
    both = good & (ok[:, 0] == 1)
    assert both.sum() > 0.8 * len(corners)
    ours, theirs = (np.linalg.norm(one - truth, axis=1)[both] for one in (found - 0.5, there[:, 0]))
    return float(np.median(ours)), float(np.median(theirs))


def test_it_is_as_good_as_opencv_where_the_image_only_moves() -> None:
    shift = 0.8, -0.5
    a, b = picture(scene((0.0, 0.0)), 1.0), picture(scene(shift), 1.0)
    ours, theirs = errors_of_both(a, b, np.column_stack([np.eye(2), shift]))
    assert ours < 1.2 * theirs


@pytest.mark.parametrize(
    ("degrees", "growth", "gain", "light"), [(0, 1, 0.8, 0.05), (0, 1, 1.25, 0), (4, 1, 1, 0), (0, 1.05, 1, 0)]
)
def test_a_change_of_light_a_turn_or_growth_moves_no_track(
    degrees: float, growth: float, gain: float, light: float
) -> None:
    here = 0.7 * scene((0.0, 0.0))
    motion = cv2.getRotationMatrix2D((W / 2 - 0.5, H / 2 - 0.5), degrees, growth)
    motion[:, 2] += 0.8, -0.5
    there = cv2.warpAffine(here, motion, (W, H), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    ours, theirs = errors_of_both(picture(here, 1.0), picture(gain * there + np.float32(light), 1.0), motion)
    assert ours < 0.06 and ours < 0.5 * theirs


def test_what_has_no_texture_or_lies_outside_is_not_found() -> None:
    flat = np.full((H, W), 90, np.uint8)
    places = np.array([[60.0, 40.0], [-40.0, 30.0], [W + 30.0, H + 30.0]])
    assert not flow(flat, flat, places, places, 0.6, levels=2)[1].any()
    textured = picture(scene((0.0, 0.0)), 1.0)
    far = np.array([[1e9, 40.0], [np.nan, 40.0], [-np.inf, 3.0]])
    assert not flow(textured, textured, places[:1].repeat(3, 0), far, 0.6, levels=2)[1].any()


def test_a_pyramid_may_take_the_room_of_another() -> None:
    one, other = picture(scene((0.0, 0.0)), 1.0), picture(scene((3.0, 0.0), 1), 1.0)
    buffers = pyramid(one, 2)
    again = pyramid(other, 2, buffers)
    assert all(a is b for a, b in zip(buffers, again, strict=True))
    for a, b in zip(again, pyramid(other, 2), strict=True):
        np.testing.assert_array_equal(a, b)


def test_tracks_keep_their_names_through_views() -> None:
    tracks = Tracks(target=60)
    for n in range(6):
        tracks.add(n, picture(scene((0.4 * n, 0.2 * n)), 1.0))
    kept = tracks.born == 0
    assert kept.sum() > 30
    moved = tracks.at[kept] - tracks.birthplace[kept]
    np.testing.assert_allclose(np.median(moved, axis=0), [2.0, 1.0], atol=0.03)
    assert tracks.motion_px == pytest.approx(np.hypot(0.4, 0.2), abs=0.05)


def test_a_picture_is_the_blurred_root() -> None:
    rate = scene((0.0, 0.0)) * 1.3
    expected = cv2.GaussianBlur(np.sqrt(np.clip(rate / 1.1, 0, 1)) * 255, (7, 7), 0.8)
    assert np.abs(picture(rate, 1.1).astype(float) - expected).max() <= 0.51


@pytest.mark.parametrize("share_of_zeros", [0.0, 0.5, 1.0])
def test_white_is_a_quantile(share_of_zeros: float) -> None:
    rate = np.random.default_rng(1).gamma(2.0, 0.1, (H, W)).astype(np.float32)
    rate[np.random.default_rng(2).random((H, W)) < share_of_zeros] = 0
    wanted = max(float(np.quantile(rate[::3, ::3], 0.995, method="lower")), 1e-6)
    assert white_of(rate) == pytest.approx(wanted)


@pytest.mark.parametrize("far", [0, 300])
def test_a_view_is_measured_as_its_window_says(far: int) -> None:
    rng = np.random.default_rng(4)
    start = rng.integers(0, 24, (H, W)).astype(np.uint16)
    stop = (start + far + rng.integers(1, 40, (H, W))).astype(np.uint16)
    spikes = rng.integers(1, 9, (H, W)).astype(np.uint16)
    spikes[:20] = 0
    start[:10], stop[:10] = 0xFFFF, 0xFFFF
    stop[10:20] = start[10:20]
    window = Window(100, 64 + far, 124, 140 + far, spikes, start, stop, spikes)
    view = make_view(window, Sensor(W, H, 20000.0), after_gap=False)
    valid = window.valid
    assert view.intervals.start.dtype == (np.uint16 if far else np.uint8)
    shown = view.preview_rate(np.empty((H, W), np.float32))
    np.testing.assert_allclose(shown, window.rate(fill=True), rtol=1e-6)
    np.testing.assert_array_equal(view.rate[valid], shown[valid])
    assert (view.rate[:10] == 0).all()
    p, m = window.rate()[valid], spikes[valid].astype(float)
    charge = p * p / 6 + JITTER * m + (0.01 * m) ** 2  # clock at both ends, jitter of each interval, scale
    np.testing.assert_allclose(view.deviation[valid], np.sqrt(charge) / window.duration()[valid], rtol=1e-5)
    np.testing.assert_allclose(view.deviation[~valid], 1 / window.frames, rtol=1e-6)
    assert view.spikes_a_pixel == pytest.approx(spikes.mean())
    first, last = view.intervals.times()
    middle = np.where(valid, np.nan_to_num(window.centre() - view.time), 0)
    np.testing.assert_allclose(0.5 * (first + last), middle, atol=1e-5)
    np.testing.assert_allclose(last - first, np.where(valid, window.duration(), 16 + far), atol=1e-5)


def edges_with(late: np.ndarray, kind: type) -> SpikeIntervals:
    """Of pixels that each looked for 8 frames, so many frames later than the middle of the window."""
    start = (30 + late - 4.5).astype(kind)
    return SpikeIntervals(np.ones(late.shape, kind), start, start + kind(8), 60, 16, 30.0)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_delays_are_means_where_it_is_steep(kind: type) -> None:
    image = np.zeros((H, W), np.uint8)
    image[:, 60:] = 200
    late = np.full((H, W), 3.5)
    late[:, 59:61] = -2.5
    at = np.array([[60.0, 48.0], [20.0, 48.0], [-5.0, H + 9.0], [W - 0.5, 0.5]])
    edges = edges_with(late, kind)
    found = edges.delays(image, at)
    assert found[0] == pytest.approx(-2.5, abs=0.02)
    assert found[1:] == pytest.approx([3.5, 3.5, 3.5], abs=1e-3)
    edges.spikes[:] = 0
    np.testing.assert_array_equal(edges.delays(image, at), 0)


def test_the_delay_of_a_track_is_that_of_the_edges_around_it() -> None:
    image = np.zeros((40, 40), np.uint8)
    image[10:20, 10:20] = 200
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    late = np.full((40, 40), 9.5)
    late[6:24, 6:24] = 2.5
    assert abs(edges_with(late, np.uint8).delays(image, np.array([[15.0, 15.0]]))[0] - 2.5) < 0.1


def steady(seed: int = 0) -> Tracks:
    """Tracks of a scene that moved half a pixel from each of four views to the next, 1.5 px in all."""
    tracks = Tracks(target=60)
    for n in range(4):
        tracks.add(n, picture(scene((0.5 * n, 0.0), seed), 1.0))
    return tracks


@pytest.mark.parametrize(("jump_px", "least_right"), [(0.0, 1.0), (2.5, 0.9), (9.0, 0.55)])
def test_tracks_outlive_a_motion_that_nobody_expected(jump_px: float, least_right: float) -> None:
    began = right = kept = 0
    for seed in range(6):
        tracks = steady(seed)
        before = dict(zip(tracks.ids.tolist(), tracks.at, strict=True))
        motion = tracks.add(4, picture(scene((2.0 + jump_px, 0.0), seed), 1.0))
        assert motion == pytest.approx(0.5 + jump_px, abs=0.05)
        found = [(at, before[i]) for i, at in zip(tracks.ids.tolist(), tracks.at, strict=True) if i in before]
        error = np.array([np.linalg.norm(at - was - (0.5 + jump_px, 0)) for at, was in found])
        began, right, kept = began + len(before), right + (error < 0.3).sum(), kept + len(found)
    assert right >= least_right * began and right > 0.9 * kept


@pytest.mark.parametrize(("jump_px", "looks_again"), [(0.5, False), (9.0, True)])
def test_tracks_that_go_on_as_they_went_are_not_searched(
    monkeypatch: pytest.MonkeyPatch, jump_px: float, looks_again: bool
) -> None:
    tracks, searches = steady(), []
    sought = Tracks._searched
    monkeypatch.setattr(Tracks, "_searched", lambda *all_: searches.append(1) or sought(*all_))
    tracks.add(4, picture(scene((1.5 + jump_px, 0.0)), 1.0))
    assert bool(searches) == looks_again


def test_fine_repetition_after_a_gap_is_not_taken_for_standing_still() -> None:
    """A grid of 4 px over a third as much of other texture, which moved by a little more than its period meanwhile."""
    y, x = np.mgrid[:H, :W].astype(np.float32)

    def view(moved_px: float) -> np.ndarray:
        grid = 0.5 + 0.25 * np.sin(np.pi / 2 * (x - moved_px)) + 0.25 * np.sin(np.pi / 2 * y)
        return picture((0.7 * grid + 0.3 * scene((moved_px, 0.0))).astype(np.float32), 1.0)

    for after_gap in (False, True):
        tracks = Tracks(target=60)
        for n in range(5):
            tracks.add(n, view(0.5 * n))
        motion = tracks.add(5, view(2.0 + 4.5), after_gap)
        assert motion == pytest.approx(4.5 if after_gap else 0.5, abs=0.1)


def test_the_median_is_that_of_numpy() -> None:
    for count in (1, 2, 7, 8):
        values = np.random.default_rng(count).normal(size=count)
        assert median(values) == pytest.approx(float(np.median(values)), abs=1e-15)


def test_tracks_are_placed_where_their_rays_meet() -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform((-2, -2, 4), (2, 2, 8), (30, 3))
    centres = rng.normal(0, 0.3, (6, 3))
    rotations = exp_so3(rng.normal(0, 0.05, (6, 3)))
    view, track = (g.ravel() for g in np.meshgrid(np.arange(6), np.arange(30), indexing="ij"))
    local = np.einsum("mji,mj->mi", rotations[view], points[track] - centres[view])
    lens = 500.0, 510.0, 200.0, 125.0
    pixels = local[:, :2] / local[:, 2:] * lens[:2] + lens[2:]
    pixels[track == 3] += rng.normal(0, 20, (6, 2))  # rays that do not meet
    found = np.full((31, 3), np.nan)
    found[30] = 1.0  # known, and seen by nobody
    _bundle.triangulate(rotations, centres, view, track, pixels, *lens, 5, 0.5, 2.0, found)
    assert np.isnan(found[3]).all() and (found[30] == 1).all()
    np.testing.assert_allclose(np.delete(found[:30], 3, 0), np.delete(points, 3, 0), atol=1e-9)
    with pytest.raises(ValueError, match="does not exist"):
        _bundle.triangulate(rotations, centres, view + 1, track, pixels, *lens, 5, 0.5, 2.0, found)


def test_depths_of_little_parallax_are_not_biased() -> None:
    """2,000 points 5 away, 2.5 px of parallax over 8 views, tracks off by 0.15 px: the point nearest to the rays lies
    5 % too near."""
    rng, count, views, focal_px = np.random.default_rng(1), 2000, 8, 350.0
    points = np.stack([rng.uniform(-2, 2, count), rng.uniform(-1, 1, count), np.full(count, 5.0)], 1)
    centres = np.zeros((views, 3))
    centres[:, 0] = np.linspace(0, 2.5 / focal_px * 5.0, views)
    view, track = (g.ravel() for g in np.meshgrid(np.arange(views), np.arange(count), indexing="ij"))
    local = points[track] - centres[view]
    pixels = focal_px * local[:, :2] / local[:, 2:] + (200, 125) + rng.normal(0, 0.15, (len(view), 2))
    rotations, lens = np.repeat(np.eye(3)[None], views, 0), (focal_px, focal_px, 200.0, 125.0)
    found, nearest = np.full((2, count, 3), np.nan)
    _bundle.triangulate(rotations, centres, view, track, pixels, *lens, 5, 0.1, 2.0, nearest)
    _bundle.triangulate(rotations, centres, view, track, pixels, *lens, 5, 0.1, 2.0, found, steps=3)
    assert np.isfinite(found).all()
    assert np.median(nearest[:, 2]) == pytest.approx(0.95 * 5.0, rel=0.01)
    assert np.median(found[:, 2]) == pytest.approx(5.0, rel=0.01)
    assert 1 / np.mean(1 / found[:, 2]) == pytest.approx(5.0, rel=0.01)


def test_results_are_never_written_to_a_copy() -> None:
    edges = edges_with(np.zeros((H, W)), np.uint8)
    for out in (np.empty((H, W)), np.empty((H, 2 * W), np.float32)[:, ::2]):
        with pytest.raises(TypeError):
            edges.picture(out)  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        _geometry.exponentials(np.zeros((2, 3)), np.empty((2, 9), np.float32))


@pytest.mark.parametrize("rate", [0.0, 0.002, 0.008, 0.012, 0.017, 0.022, 0.03])
def test_rates_of_the_dark_are_right_in_the_mean(rate: float) -> None:
    """Of windows in which few or no pixels fire twice: a map is fitted to their mean."""
    frames, sensor = 80, Sensor(W, H, 20000.0)
    phase = np.random.default_rng(5).random((H, W))
    charge = phase + rate * np.arange(frames + 1)[:, None, None]
    bits = (np.floor(charge[1:]) > np.floor(charge[:-1])).astype(np.uint8)
    stored = np.packbits(bits.reshape(frames, -1), axis=1, bitorder="little")
    view = make_view(aligned_window(stored, sensor, 0, 24, 56), sensor, after_gap=False)
    assert float(view.rate.mean()) == pytest.approx(rate, rel=0.03)
