"""Least squares and elimination against the plain thing: all poses at once, no Schur complement."""

from __future__ import annotations

import numpy as np
import pytest

from systems.estimators.formation_information import (
    leave,
    linearisation_point,
    solve,
    start,
)
from systems.estimators.formation_model import Layout, Sightings, jacobian, predict
from tests.formation_world import AROUND, OFFSET

LAYOUT = Layout(3, AROUND, OFFSET)
X = np.concatenate([[0, 0, 0.1, 1.5, 0, 0.3, 0.75, 1.3, -0.2], np.full(12, 0.01)])
DEVIATIONS = np.concatenate([np.tile([0.01, 0.01, 0.02], 3), np.full(12, 0.005)])


def all_sightings(x: np.ndarray, seed: int) -> tuple[Sightings, np.ndarray]:
    """Each robot sees a side of each other in the camera that faces it; noise 1 mrad and 1 %."""
    random = np.random.default_rng(seed)
    rows = []
    for i in range(3):
        for j in range(3):
            if i != j:
                every = Sightings(
                    np.full(4, i), np.arange(4), np.full(4, 4 * j + (i + j) % 4), np.zeros((4, 2))
                )
                values = predict(LAYOUT, x, every)
                c = int(np.argmin(np.abs(values[:, 0])))
                rows.append((i, c, 4 * j + (i + j) % 4, values[c]))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    columns[3] = columns[3] + [1e-3, 1e-2] * random.standard_normal((6, 2))
    return Sightings(*columns), np.tile([1e6, 1e4], (6, 1))


def test_solution_of_exact_sightings_is_the_truth() -> None:
    """From a start that is 5 cm and 3 degrees off, with a prior that is weak."""
    prior = start(LAYOUT, X, np.full(LAYOUT.size, 1e3))
    strong = start(LAYOUT, X, np.where(np.arange(LAYOUT.size) < 3, 1e-3, 1e3))
    seen, weights = all_sightings(X, 0)
    seen = seen._replace(values=predict(LAYOUT, X, seen))
    begin = X + 0.05 * np.where(np.arange(LAYOUT.size) < 9, 1, 0)
    found = solve(LAYOUT, strong, seen, weights, begin)
    np.testing.assert_allclose(found.residuals, 0.0, atol=1e-4)
    np.testing.assert_allclose(found.x[:2], X[:2], atol=1e-6)
    assert found.cost == pytest.approx(0.0, abs=1e-6)
    assert solve(LAYOUT, prior, seen, weights, X).cost == pytest.approx(0.0, abs=1e-6)


def test_the_prior_alone_gives_itself_back() -> None:
    prior = start(LAYOUT, X, DEVIATIONS)
    nobody = Sightings(*(np.zeros(0, np.intp),) * 3, np.zeros((0, 2)))
    found = solve(LAYOUT, prior, nobody, np.zeros((0, 2)), X + 1.0)
    np.testing.assert_allclose(found.x, X, atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(found.information), np.diag(DEVIATIONS**2), atol=1e-12)


def test_leaving_is_what_all_poses_at_once_give() -> None:
    """The covariance, and the estimate to first order, with the old pose as a state beside."""
    prior = start(LAYOUT, X, DEVIATIONS)
    seen, weights = all_sightings(X, 1)
    x = solve(LAYOUT, prior, seen, weights, X).x
    own = (seen.observer == 1) | (seen.target == 1)
    far = np.array([0.2, 0.3, 0.4])  # a weak link
    moved = np.array([1.0, 2.0, 0.5])
    after = leave(
        LAYOUT, prior, seen.select(own), weights[own], x, 1, displacement=moved, deviations=far
    )
    rest = seen.select(~own)
    y = x.copy()
    y[3:6] += moved
    found = solve(LAYOUT, after, rest, weights[~own], y)

    # The state with the old pose of robot 1 kept at the end.
    n = LAYOUT.size
    W = weights.ravel()
    J = jacobian(LAYOUT, x, seen).reshape(-1, n)
    J_rest = jacobian(LAYOUT, y, rest).reshape(-1, n)
    H = np.zeros((n + 3, n + 3))
    new, old = np.arange(3, 6), np.arange(n, n + 3)
    place = np.arange(n)
    place[3:6] = old
    own_rows = np.repeat(own, 2)
    H[np.ix_(place, place)] += np.diag(DEVIATIONS**-2.0)
    H[np.ix_(place, place)] += (J[own_rows].T * W[own_rows]) @ J[own_rows]
    H[:n, :n] += (J_rest.T * W[~own_rows]) @ J_rest
    link = np.diag(far**-2.0)
    for a, b, sign in ((new, new, 1), (old, old, 1), (new, old, -1), (old, new, -1)):
        H[np.ix_(a, b)] += sign * link
    np.testing.assert_allclose(
        np.linalg.inv(found.information), np.linalg.inv(H)[:n, :n], rtol=1e-6, atol=1e-12
    )
    # Nothing new has been measured: the others stay, and the robot is where it said it went.
    np.testing.assert_allclose(found.x, y, atol=1e-6)


def test_derivatives_stay_where_a_neighbour_left() -> None:
    prior = start(LAYOUT, X, DEVIATIONS)
    seen, weights = all_sightings(X, 2)
    x = solve(LAYOUT, prior, seen, weights, X).x
    own = (seen.observer == 1) | (seen.target == 1)
    zero, far = np.zeros(3), np.full(3, 10.0)
    after = leave(
        LAYOUT, prior, seen.select(own), weights[own], x, 1, displacement=zero, deviations=far
    )
    assert after.fixed.tolist() == [True, False, True]
    shifted = linearisation_point(after, x + 0.1)
    expected = x + 0.1
    expected[[0, 1, 2, 6, 7, 8]] = x[[0, 1, 2, 6, 7, 8]]
    np.testing.assert_allclose(shifted, expected)


def test_writing_a_prior_about_another_point_changes_nothing() -> None:
    prior = start(LAYOUT, X, DEVIATIONS)
    other = prior.about(X + 0.3)
    nobody = Sightings(*(np.zeros(0, np.intp),) * 3, np.zeros((0, 2)))
    found = solve(LAYOUT, other, nobody, np.zeros((0, 2)), X - 1.0)
    np.testing.assert_allclose(found.x, X, atol=1e-9)
