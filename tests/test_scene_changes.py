"""Changes of a scene: what is written is read back, a mirror follows, and garbage is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spiked.errors import SceneError
from spiked.scene_changes import SceneChanges, SceneMirror


def some(filled: list[int], emptied: list[int], slots: int, whole: bool = False, channels: int = 1) -> SceneChanges:
    random, n = np.random.default_rng(sum(filled)), len(filled)
    return SceneChanges(
        whole,
        3,
        9,
        2,
        slots,
        np.uint32(emptied).reshape(-1),
        np.uint32(filled).reshape(-1),
        random.normal(size=(n, 3)).astype(np.float32),
        random.normal(-4, 1, (n, 3)).astype(np.float16),
        random.uniform(0, 1, (n, channels)).astype(np.float16),
        random.integers(-127, 128, (n, 4), np.int8),
        random.integers(0, 256, n, np.uint8),
    )


@pytest.mark.parametrize("channels", [1, 3])
def test_what_is_written_is_read_back(channels: int) -> None:
    changes = some([5, 1, 7], [0], 8, channels=channels)
    again = SceneChanges.read(changes.write())
    assert (again.state, again.whole, again.slots) == ("3-9-2", False, 8)
    for name in ("emptied", "filled", "means", "log_scales", "colours", "quats", "opacities"):
        np.testing.assert_array_equal(getattr(again, name), getattr(changes, name))


def test_a_mirror_follows_and_asks_for_the_whole_when_it_cannot() -> None:
    mirror = SceneMirror()
    assert mirror.state is None
    first = some([0, 1, 2, 3], [], 4, whole=True)
    mirror.apply(first)
    then = some([1, 5], [0, 2], 6)
    mirror.apply(then)
    scene = mirror.scene(white=0.5)
    np.testing.assert_array_equal(scene.means, np.concatenate([then.means[:1], first.means[3:], then.means[1:]]))
    np.testing.assert_array_equal(scene.colours[2], np.float32(then.colours[1]) / 2)
    assert mirror.state == "3-9-2"
    with pytest.raises(SceneError, match="ask for the whole"):
        mirror.apply(some([1], [], 6, channels=3))
    with pytest.raises(SceneError, match="ask for the whole"):
        mirror.apply(some([1], [], 2))


@given(st.integers(0, 400), st.binary(max_size=8), st.booleans())
def test_garbage_is_refused(at: int, noise: bytes, cut: bool) -> None:
    raw = some([5, 1, 7], [0], 8).write()
    damaged = raw[:at] + noise + (b"" if cut else raw[at + len(noise) :])
    try:
        found = SceneChanges.read(damaged)
    except SceneError:
        return
    SceneMirror().apply(found if found.whole else some(list(range(8)), [], 8, whole=True))
