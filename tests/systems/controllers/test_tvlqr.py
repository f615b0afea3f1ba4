from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from pydrake.systems.primitives import FirstOrderTaylorApproximation

from systems.controllers.path_tracking import driven, error_of
from systems.controllers.tvlqr import TvlqrParameters, error_model, schedule
from systems.controllers.unicycle import Unicycle, linearized
from tests.systems.controllers.tracking import circle, straight

Q, R = TvlqrParameters().weights()


def test_many_points_are_linearised_as_drake_does_one() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (5, 5))
    A, B = linearized(Unicycle(), points[:, :3], points[:, 3:])
    plant = Unicycle()
    for k, point in enumerate(points):
        context = plant.CreateDefaultContext()
        context.SetContinuousState(point[:3])
        plant.command_input_port().FixValue(context, point[3:])
        theirs = FirstOrderTaylorApproximation(plant, context)
        np.testing.assert_allclose(A[k], theirs.A(), atol=1e-14)
        np.testing.assert_allclose(B[k], theirs.B(), atol=1e-14)


@pytest.mark.parametrize("speeds", [[0.4, 0.0], [0.5, 0.9], [0.3, -1.2]])
def test_the_error_model_is_the_derivative_of_driving(speeds: list[float]) -> None:
    dt, h = 0.05, 1e-6
    (A,), (B,) = error_model(np.array([speeds]), dt)
    reference = driven(np.zeros(3), np.array(speeds), dt)

    def after(e: np.ndarray, d: np.ndarray) -> np.ndarray:
        return error_of(driven(e, speeds + d, dt), reference)

    for k in range(3):
        e = h * np.eye(3)[k]
        slope = (after(e, np.zeros(2)) - after(-e, np.zeros(2))) / (2 * h)
        np.testing.assert_allclose(A[:, k], slope, atol=1e-5)
    for k in range(2):
        d = h * np.eye(2)[k]
        slope = (after(np.zeros(3), d) - after(np.zeros(3), -d)) / (2 * h)
        np.testing.assert_allclose(B[:, k], slope, atol=1e-5)


def dare(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    S = scipy.linalg.solve_discrete_are(A, B, Q, R)
    return S, np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)


def test_far_from_the_end_of_a_straight_line_it_is_the_algebraic_solution() -> None:
    plan = schedule(straight(12.0), 20.0, Q, R)
    S, K = dare(plan.A[0], plan.B[0])
    np.testing.assert_allclose(plan.S[0], S, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(plan.K[0], K, rtol=1e-6, atol=1e-6)
    # What lies across and what lies along have nothing to do with one another.
    np.testing.assert_allclose(K[0, 1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(K[1, 0], 0.0, atol=1e-12)
    assert not np.allclose(plan.K[-1], K, rtol=0.1)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_all_around_a_circle_it_is_the_algebraic_solution(way: float) -> None:
    plan = schedule(circle(way=way), 20.0, Q, R)
    S, K = dare(plan.A[0], plan.B[0])
    for k in (0, 100, len(plan.K) - 1):
        np.testing.assert_allclose(plan.S[k], S, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(plan.K[k], K, rtol=1e-6, atol=1e-6)


def test_the_cost_it_foretells_is_what_an_error_costs() -> None:
    plan = schedule(circle(0.7), 20.0, Q, R)
    start = np.array([0.03, -0.05, 0.2])
    e, cost = start, 0.0
    for k in plan.following(17, 3000):
        d = -plan.K[k] @ e
        cost += e @ Q @ e + d @ R @ d
        e = plan.A[k] @ e + plan.B[k] @ d
    assert cost == pytest.approx(start @ plan.S[17] @ start, rel=1e-9)


def test_an_open_route_ends_with_its_last_step() -> None:
    plan = schedule(straight(2.0), 20.0, Q, R)
    assert len(plan.K) == 100
    assert plan.index(99.0) == 99
    np.testing.assert_array_equal(plan.following(97, 5), [97, 98, 99, 99, 99])
    closed = schedule(circle(), 20.0, Q, R)
    assert closed.index(circle().duration + 0.1) == 2


def test_weights_must_be_positive() -> None:
    with pytest.raises(ValueError, match="across"):
        TvlqrParameters(across=0.0)
