"""The fused Adam against torch's, and its own rules about splats that are not seen."""

import numpy as np
import pytest
import torch

from spiked.errors import ConfigurationError
from spiked.pose import rotation_of
from spiked.render.optimiser import Adam
from spiked.render.splats import MeanAxes
from spiked.scene import Scene

SHAPES = ((203, 3), (203, 4), (203,), (203, 1))


def arrays(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=shape).astype(np.float32) for shape in SHAPES]


def test_steps_match_torch() -> None:
    ours = arrays(0)
    theirs = [torch.tensor(a.astype(np.float64), requires_grad=True) for a in ours]
    rates = [1e-2, 3e-3, 5e-2, 1e-3]
    adam = Adam(ours)
    torch_adam = torch.optim.Adam([{"params": [t], "lr": r} for t, r in zip(theirs, rates, strict=True)], eps=1e-15)
    for step in range(20):
        gradients = arrays(step + 1)
        adam.step(ours, gradients, rates)
        for parameter, gradient in zip(theirs, gradients, strict=True):
            parameter.grad = torch.tensor(gradient.astype(np.float64))
        torch_adam.step()
    for a, t in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, t.detach().numpy(), atol=3e-6)


def test_unseen_splats_stay_and_start_fresh_when_they_come() -> None:
    parameters, gradients = arrays(0), arrays(1)
    before = [a.copy() for a in parameters]
    seen = np.arange(203) % 3 == 0
    adam = Adam(parameters)
    for _ in range(7):
        adam.step(parameters, gradients, [0.1] * 4, seen)
    for a, b in zip(parameters, before, strict=True):
        assert np.array_equal(a[~seen], b[~seen])
        assert (a[seen] != b[seen]).all()
    assert set(adam.taken[seen]) == {7}
    assert set(adam.taken[~seen]) == {0}
    adam.step(parameters, gradients, [0.1] * 4, ~seen)
    # The first step of Adam is the rate, whatever the gradient.
    for a, b in zip(parameters, before, strict=True):
        np.testing.assert_allclose(np.abs(a - b)[~seen], 0.1, rtol=1e-4)


def test_moments_follow_the_scene() -> None:
    parameters, gradients = arrays(0), arrays(1)
    adam = Adam(parameters)
    adam.step(parameters, gradients, [0.1] * 4)
    rows = np.arange(203) % 2 == 0
    adam.keep(rows)
    adam.grow(5)
    kept = [np.concatenate([a[rows], a[:5]]) for a in parameters]
    kept_gradients = [np.concatenate([g[rows], g[:5]]) for g in gradients]
    assert adam.taken.tolist() == [1] * 102 + [0] * 5
    adam.step(kept, kept_gradients, [0.1] * 4)
    whole = Adam(parameters)
    again = arrays(0)
    whole.step(again, gradients, [0.1] * 4)
    whole.step(again, gradients, [0.1] * 4)
    np.testing.assert_array_equal(kept[0][:102], again[0][rows])
    adam.reset(np.array([0, 3]))
    assert adam.taken.tolist()[:4] == [0, 2, 2, 0]


def test_a_scene_that_grew_alone_is_refused() -> None:
    parameters = arrays(0)
    adam = Adam(parameters)
    grown = [np.concatenate([a, a[:1]]) for a in parameters]
    with pytest.raises(ConfigurationError, match=r"call grow\(\) and keep\(\)"):
        adam.step(grown, grown, [0.1] * 4)
    with pytest.raises(ConfigurationError, match="4 arrays"):
        adam.step(parameters[:2], parameters[:2], [0.1] * 2)
    wide = [a.astype(np.float64) for a in parameters]
    with pytest.raises(ConfigurationError, match="float32"):
        adam.step(wide, parameters, [0.1] * 4)


def test_the_number_of_threads_changes_no_bit() -> None:
    rng = np.random.default_rng(0)
    start = [rng.normal(size=(20_000, 3)).astype(np.float32), rng.normal(size=20_000).astype(np.float32)]
    gradients, seen = [rng.normal(size=a.shape).astype(np.float32) for a in start], rng.random(20_000) < 0.7
    moved = [[a.copy() for a in start] for _ in range(2)]
    for arrays, threads in zip(moved, (1, 3), strict=True):
        adam = Adam(arrays, threads=threads)
        for _ in range(2):
            adam.step(arrays, gradients, [1e-2, 1e-3], seen)
    for one, three, before in zip(*moved, start, strict=True):
        np.testing.assert_array_equal(one, three)
        assert (one != before).any(axis=tuple(range(1, one.ndim))).tolist() == seen.tolist()


@pytest.mark.parametrize("own", [True, False])
def test_means_move_along_axes(own: bool) -> None:
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(203, 4)).astype(np.float32)
    log_scales, means = rng.normal(-3, 1, (203, 3)).astype(np.float32), rng.normal(size=(203, 3)).astype(np.float32)
    slopes, steps = (rng.normal(size=(203, 3)).astype(np.float32) for _ in range(2))
    scene = Scene(means.copy(), quats, log_scales, np.zeros(203, np.float32), np.zeros((203, 1), np.float32))
    if own:
        lengths = np.sqrt(np.exp(2 * log_scales) + 0.05**2)
        axes = np.stack([rotation_of(quat) for quat in quats.astype(float)]) * lengths[:, None]
    else:
        axes = np.tile(0.05 * np.eye(3), (203, 1, 1))
    adam = Adam(arrays(0))
    by_axes = adam.slopes_along_axes(scene, MeanAxes(0.05, own), slopes)
    np.testing.assert_allclose(by_axes, np.einsum("nij,ni->nj", axes, slopes), atol=1e-6)
    adam.move_along_axes(scene, MeanAxes(0.05, own), steps)
    np.testing.assert_allclose(scene.means - means, np.einsum("nij,nj->ni", axes, steps), atol=1e-6)
