from __future__ import annotations

import numpy as np
import pytest

from systems.markers.corner_noise import corner_deviation, narrow_side

SQUARE = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) / 2


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.2])
@pytest.mark.parametrize("axis", [0.0, 0.4, np.pi / 4, 2.0])
def test_a_tilted_square_has_its_side_times_the_cosine(tilt: float, axis: float) -> None:
    # Shortened across the axis of the tilt, whichever way that lies in the marker.
    c, s = np.cos(axis), np.sin(axis)
    R = np.array([[c, -s], [s, c]])
    shortened = SQUARE @ (R @ np.diag([1.0, np.cos(tilt)]) @ R.T).T
    corners = np.array([40.0 * shortened + [300.0, 200.0], 10.0 * shortened @ R.T])
    np.testing.assert_allclose(narrow_side(corners), np.cos(tilt) * np.array([40.0, 10.0]))


def test_the_noise_falls_with_the_side() -> None:
    corners = SQUARE * np.array([10.0, 20.0, 1000.0])[:, None, None]
    expected = np.sqrt(0.02**2 + (1.5 / np.array([10.0, 20.0, 1000.0])) ** 2)
    np.testing.assert_allclose(corner_deviation(corners, 0.02, 1.5), expected)
    np.testing.assert_array_equal(corner_deviation(corners, 0.3, 0.0), 0.3)
    # What is seen edge on has a finite noise too.
    assert corner_deviation(np.zeros((1, 4, 2)), 0.02, 1.5) == pytest.approx(1.5, rel=1e-3)
