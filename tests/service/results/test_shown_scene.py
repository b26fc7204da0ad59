"""The scene as viewers hold it: they end with what is true, and little travels when little has changed."""

from pathlib import Path

import numpy as np
import pytest
from spiked_service.results.shown_scene import TOLERANCE, ShownScene

from spiked.errors import SceneError
from spiked.render import Camera
from spiked.render.choice import rasteriser_for
from spiked.scene import Scene
from spiked.scene_changes import SceneChanges, SceneMirror
from spiked.sensor import Intrinsics

COUNT = 3000
WHITE = 0.4


def room(seed: int = 0, count: int = COUNT, channels: int = 1) -> Scene:
    """A wall of opaque splats two units ahead."""
    random = np.random.default_rng(seed)
    means = np.c_[random.uniform(-1, 1, (count, 2)), random.normal(2, 0.05, count)].astype(np.float32)
    return Scene(
        means,
        random.normal(0, 1, (count, 4)).astype(np.float32),
        random.normal(-3.5, 0.3, (count, 3)).astype(np.float32),
        random.normal(1, 1, count).astype(np.float32),
        np.float32(WHITE * (0.5 + 0.5 * np.sin(4 * means[:, :1] + np.arange(channels)))),
    )


def moved(scene: Scene, by: float, seed: int) -> Scene:
    """All splats a little elsewhere, some removed, some new at the end."""
    random = np.random.default_rng(seed)
    keep = random.uniform(size=len(scene)) > 0.02
    new = scene.select(keep).join(room(seed, 40, scene.colours.shape[1]))
    new.means += random.normal(0, by, new.means.shape).astype(np.float32)
    new.colours += random.normal(0, by * WHITE, new.colours.shape).astype(np.float32)
    return new


def carried(changes: SceneChanges) -> SceneChanges:
    return SceneChanges.read(changes.write())


def pictures_psnr_db(one: Scene, other: Scene) -> float:
    rasteriser = rasteriser_for(Camera(Intrinsics(160, 160, 80, 60), 160, 120), 1)
    a, b = (rasteriser.forward(scene, np.eye(3)[None], np.zeros((1, 3))).values / WHITE for scene in (one, other))
    return float(-10 * np.log10(max(np.mean((a - b) ** 2), 1e-12)))


@pytest.mark.parametrize("channels", [1, 3])
def test_who_follows_and_who_comes_late_see_the_scene(channels: int) -> None:
    shown, follower, scene = ShownScene(), SceneMirror(), room(channels=channels)
    seen: list[int | None] = [None, 1, None, 2, 4]
    for version, since in enumerate(seen, 1):
        shown.update(scene, WHITE, version)
        if version != 3:  # a version that this viewer misses
            follower.apply(carried(shown.since(since)))
            late = SceneMirror()
            late.apply(carried(shown.since(None)))
            assert pictures_psnr_db(follower.scene(WHITE), scene) > 45
            for mine, whole in zip(follower.scene().arrays(), late.scene().arrays(), strict=True):
                np.testing.assert_array_equal(mine, whole)
        scene = moved(scene, 0.002, version)


def test_what_cannot_be_seen_does_not_travel_until_it_adds_up() -> None:
    shown, scene = ShownScene(), room()
    shown.update(scene, WHITE, 1)
    whole = len(shown.since(None).write())
    step = np.float32(0.2 * TOLERANCE * WHITE)
    for version in range(2, 5):
        scene.colours += step
        shown.update(scene, WHITE, version)
        assert len(shown.since(version - 1)) == 0
    for version in range(5, 9):
        scene.colours += step
        shown.update(scene, WHITE, version)
    assert len(shown.since(4)) > COUNT / 2
    near = np.flatnonzero(scene.means[:, 0] > 0.9)
    scene.colours[near] += WHITE
    shown.update(scene, WHITE, 9)
    assert set(near) <= set(shown.since(8).filled.tolist())
    assert len(shown.since(8).write()) < 0.2 * whole
    shown.update(scene, WHITE, 10, tolerance=0.0)
    assert pictures_psnr_db(mirrored(shown), scene) > 55


def mirrored(shown: ShownScene) -> Scene:
    mirror = SceneMirror()
    mirror.apply(carried(shown.since(None)))
    return mirror.scene(WHITE)


def test_slots_are_found_again_whatever_the_order_and_used_again() -> None:
    shown, scene = ShownScene(), room()
    shown.update(scene, WHITE, 1)
    halves = np.r_[COUNT // 2 : COUNT, : COUNT // 2]
    shown.update(scene.select(halves), WHITE, 2)
    assert len(shown.since(1)) < 0.05 * COUNT
    shown.update(scene.select(np.arange(COUNT // 4)), WHITE, 3)
    assert len(shown.since(2).emptied) == pytest.approx(COUNT * 3 / 4, rel=0.05)
    shown.update(room(7), WHITE, 4)
    assert shown.since(3).slots == COUNT
    assert len(mirrored(shown)) == COUNT


def test_a_state_of_other_slots_is_never_continued() -> None:
    """Of a second reconstruction of the capture, or of a backup that was restored: both count versions from 1."""
    one, other = ShownScene(), ShownScene()
    for shown in (one, other):
        shown.update(room(), WHITE, 1)
    assert one.since(None).state != other.since(None).state
    began = one.began
    one.update(moved(room(), 0.002, 1), WHITE, 2)
    assert one.began == began


def test_levels_of_detail_are_parts_of_each_other() -> None:
    shown = ShownScene()
    shown.update(room(), WHITE, 1)
    sixteenth, quarter, whole = (set(shown.since(None, level).filled.tolist()) for level in range(3))
    assert sixteenth < quarter < whole
    assert (len(sixteenth), len(quarter), len(whole)) == (
        pytest.approx(COUNT / 16, rel=0.1),
        pytest.approx(COUNT / 4, rel=0.02),
        COUNT,
    )
    shown.update(moved(room(), 0.5, 1), WHITE, 2)
    assert set(shown.since(1, 1).filled.tolist()) < set(shown.since(1).filled.tolist())


def test_slots_are_read_back_and_a_damaged_file_is_refused(tmp_path: Path) -> None:
    shown, path = ShownScene(), tmp_path / "a.slots"
    shown.update(room(), WHITE, 4)
    shown.update(moved(room(), 0.01, 1), WHITE, 5)
    shown.write(path)
    again = ShownScene.read(path, shown.began, 5)
    assert again.since(4).write() == shown.since(4).write()
    raw = path.read_bytes()
    for damaged in (b"", raw[:-1], raw[:40], b"\x93NUMPY" + bytes(200)):
        path.write_bytes(damaged)
        with pytest.raises(SceneError, match="cannot read"):
            ShownScene.read(path, 4, 5)
    np.save(tmp_path / "other.npy", np.zeros(3))
    with pytest.raises(SceneError, match="another format"):
        ShownScene.read(tmp_path / "other.npy", 4, 5)
