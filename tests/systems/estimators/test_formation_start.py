"""The first guess of a robot's pose, from whatever there is to see."""

from __future__ import annotations

import numpy as np
import pytest

from systems.estimators.formation_model import Layout, Sightings, predict
from systems.estimators.formation_start import guess
from tests.formation_world import AROUND, OFFSET

LAYOUT = Layout(3, AROUND, OFFSET)
POSES = np.array([[0.0, 0.0, 0.2], [1.5, 0.1, -0.4], [0.8, 1.3, 7.0]])
TRUE = np.concatenate([POSES.ravel(), np.full(12, 0.02)])


def sightings(pairs: list[tuple[int, int]]) -> Sightings:
    """Exact ones: who sees whom, each by the marker and the camera that face one another."""
    rows = []
    for i, j in pairs:
        away = np.arctan2(*(POSES[i] - POSES[j])[1::-1]) - POSES[j, 2]
        marker = 4 * j + round(away / (np.pi / 2)) % 4
        every = Sightings(np.full(4, i), np.arange(4), np.full(4, marker), np.zeros((4, 2)))
        values = predict(LAYOUT, TRUE, every)
        c = int(np.argmin(np.abs(values[:, 0])))
        rows.append((i, c, marker, values[c]))
    i, c, marker, values = (np.array(column) for column in zip(*rows, strict=True))
    return Sightings(i, c, marker, values)


def lost(robot: int) -> np.ndarray:
    x = TRUE.copy()
    x[3 * robot : 3 * robot + 3] += [5.0, -7.0, 2.0]
    return x


def off(robot: int, found: np.ndarray) -> np.ndarray:
    difference = (found - TRUE)[3 * robot : 3 * robot + 3]
    difference[2] = np.remainder(difference[2] + np.pi, 2 * np.pi) - np.pi
    return np.abs(difference)


@pytest.mark.parametrize("robot", [0, 1, 2])
def test_two_that_it_sees_give_its_pose(robot: int) -> None:
    others = [k for k in range(3) if k != robot]
    found = guess(LAYOUT, lost(robot), sightings([(robot, k) for k in others]), np.array([robot]))
    np.testing.assert_allclose(off(robot, found), 0.0, atol=1e-9)


@pytest.mark.parametrize("robot", [0, 1, 2])
def test_one_that_it_sees_and_one_that_sees_it(robot: int) -> None:
    a, b = (k for k in range(3) if k != robot)
    found = guess(LAYOUT, lost(robot), sightings([(robot, a), (b, robot)]), np.array([robot]))
    assert off(robot, found)[:2].max() < OFFSET
    assert off(robot, found)[2] < 0.2


@pytest.mark.parametrize("robot", [0, 1, 2])
def test_the_side_that_it_shows_tells_its_heading_roughly(robot: int) -> None:
    others = [k for k in range(3) if k != robot]
    found = guess(LAYOUT, lost(robot), sightings([(k, robot) for k in others]), np.array([robot]))
    assert off(robot, found)[:2].max() < OFFSET
    assert off(robot, found)[2] <= np.pi / 4 + 0.1


def test_a_heading_is_given_on_the_turn_on_which_it_was() -> None:
    x = lost(0)
    x[2] += 6 * np.pi
    found = guess(LAYOUT, x, sightings([(0, 1), (0, 2)]), np.array([0]))
    assert abs(found[2] - x[2]) <= np.pi
    np.testing.assert_allclose(off(0, found), 0.0, atol=1e-9)


def test_without_sightings_it_stays_where_it_was() -> None:
    found = guess(LAYOUT, lost(0), sightings([(1, 2)]), np.array([0]))
    np.testing.assert_array_equal(found, lost(0))
