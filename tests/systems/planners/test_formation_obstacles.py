from __future__ import annotations

import math

import numpy as np
import pytest

from plants.planar_shapes import PlanarShapes
from systems.planners.formation_obstacles import Obstacles, clearance

SQUARE = np.array([[[1.0, -1.0], [3.0, -1.0], [3.0, 1.0], [1.0, 1.0]]])


def at(*xy: float) -> np.ndarray:
    return np.array(xy, float)


def test_nothing_stands_in_the_way_of_nothing() -> None:
    assert clearance(Obstacles(), at(0, 0), at(5, 0)) == math.inf


def test_circles_by_hand() -> None:
    one = Obstacles(circles=np.array([[2.0, 1.0, 0.25]]))
    assert clearance(one, at(0, 0), at(4, 0)) == pytest.approx(0.75)
    assert clearance(one, at(3, 1), at(9, 1)) == pytest.approx(0.75)  # beyond the line's end
    assert clearance(one, at(2, 1.1), at(2, 1.1)) < 0


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        (at(0, 0), at(0.5, 0), 0.5),  # stops short
        (at(0, 0), at(4, 0), 0.0),  # runs through
        (at(0, 3), at(4, 3), 2.0),  # passes by
        (at(0, 0), at(0, 9), 1.0),
        (at(2, 0), at(2.1, 0), 0.0),  # wholly inside
        (at(2, 0), at(9, 0), 0.0),  # starts inside
        (at(0, 1), at(2, 3), math.sqrt(0.5) * 1.0),  # past a corner: (1, 1) from y = x + 1
    ],
)
def test_a_square_by_hand(a: np.ndarray, b: np.ndarray, expected: float) -> None:
    for polygon in (SQUARE, SQUARE[:, ::-1]):  # of either sense
        square = Obstacles(polygons=polygon)
        assert clearance(square, a, b) == pytest.approx(expected, abs=1e-12)
        assert clearance(square, b, a) == pytest.approx(expected, abs=1e-12)


def test_a_triangle_may_repeat_its_last_corner() -> None:
    triangle = Obstacles(polygons=np.array([[[0.0, 0], [2, 0], [0, 2], [0, 2]]]))
    assert clearance(triangle, at(2, 2), at(2, 2)) == pytest.approx(math.sqrt(2))
    assert clearance(triangle, at(0.5, 0.5), at(0.5, 0.6)) == 0.0


def test_rectangles_and_circles_agree_with_another_implementation() -> None:
    random = np.random.default_rng(3)
    n = 12
    centres, headings = random.uniform(-4, 4, (2 * n, 2)), random.uniform(-3, 3, 2 * n)
    sizes, radii = random.uniform(0.2, 2, (2 * n, 2)), random.uniform(0.1, 0.6, 2 * n)
    sizes[n:], radii[:n] = 0.0, 0.0
    shapes = PlanarShapes(centres=centres, headings=headings, sizes=sizes, radii=radii)
    circles = np.column_stack([centres[n:], radii[n:]])
    obstacles = Obstacles(circles=circles, polygons=shapes.corners()[:n])
    for _ in range(200):
        a, b = random.uniform(-6, 6, (2, 2))
        if random.random() < 0.7:
            b = a + 0.2 * (b - a)
        line = PlanarShapes(
            centres=[(a + b) / 2],
            headings=[math.atan2(*(b - a)[::-1])],
            sizes=[[np.hypot(*(b - a)), 0.0]],
            radii=[0.0],
        )
        expected = shapes.distances(line).min()
        assert max(clearance(obstacles, a, b), 0) == pytest.approx(max(expected, 0), abs=1e-9)


def test_more_circles_leave_the_message_as_it_was() -> None:
    one = Obstacles(stamp=1.0, circles=np.array([[0.0, 0.0, 1.0]]))
    assert len(one.with_circles([[1.0, 1.0, 0.5]])) == 2
    assert len(one) == 1
    assert one.sound
    assert not one.with_circles([[math.nan, 0.0, 1.0]]).sound
    assert not one.with_circles([[0.0, 0.0, -1.0]]).sound
