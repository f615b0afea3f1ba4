from __future__ import annotations

import numpy as np
import pytest

from systems.planners.polyline import length_of, points_along, rest_of

CORNER = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])


def test_lengths() -> None:
    assert length_of(CORNER) == 7.0
    assert length_of(CORNER[:1]) == length_of(CORNER[:0]) == 0.0


@pytest.mark.parametrize(
    ("position", "first", "left"),
    [
        ([1.0, 0.5], [1.0, 0.0], 6.0),
        ([-1.0, -1.0], [0.0, 0.0], 7.0),
        ([3.5, 1.0], [3.0, 1.0], 3.0),
        ([3.0, 9.0], [3.0, 4.0], 0.0),
        ([3.1, -0.1], [3.0, 0.0], 4.0),
    ],
)
def test_the_rest_of_a_path(position: list[float], first: list[float], left: float) -> None:
    rest = rest_of(CORNER, np.array(position))
    np.testing.assert_allclose(rest[0], first)
    np.testing.assert_array_equal(rest[-1], CORNER[-1])
    assert length_of(rest) == pytest.approx(left)


def test_at_a_corner_the_piece_before_is_over() -> None:
    assert len(rest_of(CORNER, np.array([3.0, 0.0]))) == 2


def test_a_path_of_one_point_or_twice_the_same() -> None:
    np.testing.assert_array_equal(rest_of(CORNER[:1], np.ones(2)), CORNER[:1])
    twice = np.array([[1.0, 1.0], [1.0, 1.0]])
    assert np.isfinite(rest_of(twice, np.zeros(2))).all()


def test_places_along_a_path() -> None:
    found = points_along(CORNER, np.array([0.0, 1.5, 4.0, 99.0]))
    np.testing.assert_allclose(found, [[0, 0], [1.5, 0], [3, 1], [3, 4]])
