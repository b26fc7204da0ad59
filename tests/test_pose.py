"""SO(3): the identities that everything above relies on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from spiked.pose import exp_so3, log_so3, quaternion, rotation_of

vectors = st.tuples(*[st.floats(-1.8, 1.8)] * 3).map(np.array)


@given(vectors)
def test_exponential_agrees_with_scipy(v: np.ndarray) -> None:
    np.testing.assert_allclose(exp_so3(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-14)


@given(vectors)
def test_logarithm_undoes_exponential(v: np.ndarray) -> None:
    r = exp_so3(v)
    np.testing.assert_allclose(exp_so3(log_so3(r)), r, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, 0.99e-4, 1.01e-4, 1e-2, 3.1, np.pi - 1e-7])
def test_logarithm_is_exact_near_identity_and_near_half_a_turn(angle: float) -> None:
    v = angle * np.array([2.0, -1.0, 2.0]) / 3
    np.testing.assert_allclose(log_so3(exp_so3(v)), v, atol=1e-9, rtol=1e-9)


@given(st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_round_trip(q: np.ndarray) -> None:
    np.testing.assert_allclose(rotation_of(quaternion(rotation_of(q))), rotation_of(q), atol=1e-12)
