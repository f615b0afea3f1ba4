import math

import numpy as np
import pytest

from systems.formation.triangles import (
    HEIGHT,
    arrival_heading,
    components,
    gates,
    next_vertex,
    orientation,
    side_ratios,
)

H = HEIGHT * 1.5
# The paper's start: robots 2, 3 and 0 stand, robot 1 goes from (0, 1.30) to (3.0, 1.30).
START = np.array([[2.25, 0.0], [1.5, H], [0.75, 0.0]])
MIRROR = np.array([1.0, -1.0])


def test_the_papers_first_step_by_hand() -> None:
    assert next_vertex(START) == pytest.approx([3.0, H])
    assert next_vertex(START[::-1]) == pytest.approx([0.0, H])  # where robot 1 comes from
    assert gates(START) == pytest.approx(np.array([[1.125, H / 2], [1.875, H / 2]]))
    assert arrival_heading(next_vertex(START), START[2]) == pytest.approx(math.radians(30))
    assert orientation(START) == 1.0


def test_a_mirrored_triangle_has_the_mirrored_vertex_and_gates() -> None:
    assert orientation(START * MIRROR) == -1.0
    assert next_vertex(START * MIRROR) == pytest.approx(next_vertex(START) * MIRROR)
    assert gates(START * MIRROR) == pytest.approx(gates(START) * MIRROR)


def test_turned_and_moved_triangles_in_a_batch() -> None:
    random = np.random.default_rng(0)
    angles, shifts = random.uniform(-np.pi, np.pi, 50), random.normal(size=(50, 1, 2))
    R = np.stack([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]])
    R = R.transpose(2, 0, 1)
    moved = START @ R.transpose(0, 2, 1) + shifts
    expected = np.einsum("nij,j->ni", R, next_vertex(START)) + shifts[:, 0]
    assert next_vertex(moved) == pytest.approx(expected)


def test_the_new_triangle_is_equilateral_whatever_the_anchor_does() -> None:
    displaced = START + np.array([[0.0, 0.0], [0.0, 0.0], [0.3, -0.2]])
    triangle = np.vstack([START[:2], next_vertex(displaced)])
    assert side_ratios(triangle, 1.5) == pytest.approx(1.0)
    # The mirrored anchor would not do.
    other = np.vstack([START[:2], START[0] + START[1] - displaced[2]])
    assert np.abs(side_ratios(other, 1.5) - 1).max() > 0.1


def test_side_ratios_name_the_sides_in_order() -> None:
    triangle = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
    assert side_ratios(triangle, 2.0) == pytest.approx([1.5, 2.0, 2.5])


def test_components_are_along_and_to_the_left() -> None:
    along, aside = components(np.array([0.0, 2.0]), math.radians(60))
    assert (along, aside) == (pytest.approx(math.sqrt(3)), pytest.approx(1.0))
