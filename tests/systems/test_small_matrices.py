from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from systems.small_matrices import folded, rotation_vector_of, unfolded


def test_what_is_folded_is_the_lower_half_row_by_row() -> None:
    P = np.array([[1.0, 2.0, 4.0], [2.0, 3.0, 5.0], [4.0, 5.0, 6.0]])
    lower = folded(P)
    np.testing.assert_array_equal(lower, [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(unfolded(lower, 3), P)
    np.testing.assert_array_equal(unfolded(lower, 2), P[:2, :2])  # the first states alone


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0, np.pi - 1e-9, np.pi])
def test_a_rotation_vector_is_found_at_every_angle(angle: float) -> None:
    rng = np.random.default_rng(3)
    for axis in [*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))]:
        w = angle * axis / np.linalg.norm(axis)
        R, found = Rotation.from_rotvec(w).as_matrix(), np.empty(3)
        rotation_vector_of(R, found)
        # Half a turn one way is half a turn the other way.
        sign = -1.0 if angle == np.pi and found @ w < 0 else 1.0
        np.testing.assert_allclose(sign * found, w, atol=2e-15, rtol=1e-8)
