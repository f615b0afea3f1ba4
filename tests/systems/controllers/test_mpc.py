from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from systems.controllers.mpc import Mpc, MpcParameters, Problem, condensed, solve, unlimited
from systems.controllers.tvlqr import Schedule, Tvlqr, TvlqrParameters, schedule
from tests.systems.controllers.tracking import circle, closed_loop, straight

P = MpcParameters()
Q, R = P.weights()
PLAN: Schedule = schedule(circle(1.0), 20.0, Q, R)


def problem(
    error: list[float], n: int = 12, *, high: tuple[float, float] = (9.0, 9.0), change: float = 99.0
) -> Problem:
    ahead = PLAN.following(5, n)
    return Problem(
        error=np.array(error), A=PLAN.A[ahead], B=PLAN.B[ahead], Q=Q, R=R, S=PLAN.S[ahead[-1] + 1],
        speeds=PLAN.speeds[ahead], before=np.array([0.4, 0.4]), low=np.array([0.0, -high[1]]),
        high=np.array(high), change=np.full(2, change),
    )  # fmt: skip


def cost(p: Problem, commands: np.ndarray) -> float:
    e, total = p.error, 0.0
    for k, d in enumerate(commands.reshape(-1, 2) - p.speeds):
        e = p.A[k] @ e + p.B[k] @ d
        total += d @ R @ d + e @ (p.S if k == len(p.A) - 1 else Q) @ e
    return total


def test_the_condensed_cost_is_that_of_driving() -> None:
    p = problem([0.02, 0.05, -0.2])
    H, g = condensed(p)
    rng = np.random.default_rng(0)
    none = cost(p, p.speeds)
    for d in rng.normal(0, 0.2, (5, 24)):
        assert d @ H @ d / 2 + g @ d == pytest.approx(cost(p, p.speeds + d.reshape(-1, 2)) - none)


def test_without_limits_it_is_the_regulator() -> None:
    p = problem([0.02, 0.05, -0.2])
    best = solve(p)
    assert best is not None
    np.testing.assert_allclose(best, unlimited(p, PLAN.K[PLAN.following(5, 12)]), atol=1e-6)


@pytest.mark.parametrize(
    "p",
    [
        problem([0.0, 0.3, 0.0], high=(0.45, 0.8)),
        problem([0.0, -0.2, 0.4], high=(0.45, 0.8), change=0.1),
        problem([-0.2, 0.1, -0.5], high=(0.42, 3.0), change=0.15),
    ],
)
def test_an_independent_solver_finds_the_same(p: Problem) -> None:
    best = solve(p)
    assert best is not None
    assert p.allows(best - np.sign(best - p.speeds) * 1e-6)
    n = len(p.speeds)
    D = np.eye(2 * n) - np.eye(2 * n, k=-2)
    first = np.concatenate([p.before, np.zeros(2 * n - 2)])
    theirs = scipy.optimize.minimize(
        lambda u: cost(p, u), np.tile(p.before, n), method="SLSQP",
        bounds=scipy.optimize.Bounds(np.tile(p.low, n), np.tile(p.high, n)),
        constraints=[
            {"type": "ineq", "fun": lambda u: np.tile(p.change, n) - D @ u + first},
            {"type": "ineq", "fun": lambda u: np.tile(p.change, n) + D @ u - first},
        ],
        options={"maxiter": 500, "ftol": 1e-12},
    )  # fmt: skip
    assert theirs.success
    assert cost(p, best) == pytest.approx(theirs.fun, rel=1e-6)
    np.testing.assert_allclose(best.ravel(), theirs.x, atol=2e-3)
    clipped = np.clip(unlimited(p, PLAN.K[PLAN.following(5, 12)]), p.low, p.high)
    assert cost(p, best) < cost(p, clipped) or not p.allows(clipped)


def test_a_robot_that_is_too_fast_is_brought_back() -> None:
    p = replace(problem([0.0, 0.0, 0.0], high=(0.45, 1.0), change=0.1), before=np.array([0.9, 0.4]))
    best = solve(p)
    assert best is not None
    np.testing.assert_allclose(best[:4, 0], [0.8, 0.7, 0.6, 0.5], atol=1e-6)
    assert (best[5:, 0] <= 0.45 + 1e-6).all()


def test_where_no_limit_binds_it_drives_as_the_regulator() -> None:
    same = {"max_acceleration": 1e3, "max_turn_acceleration": 1e3, "max_turn_rate": 1e3}
    a, _, _ = closed_loop(
        Mpc(route=circle(), parameters=MpcParameters(**same)), (0.0, 0.02, 0.05), 3.0
    )
    b, _, _ = closed_loop(
        Tvlqr(route=circle(), parameters=TvlqrParameters(**same)), (0.0, 0.02, 0.05), 3.0
    )
    np.testing.assert_allclose(a, b, atol=2e-4)


def test_it_foresees_that_it_cannot_turn_fast() -> None:
    # With little turning to be had the regulator overshoots more.
    tight = {"max_turn_rate": 0.5, "max_turn_acceleration": 0.7}
    start, seconds = (0.0, 0.4, 0.0), 15.0
    a, _, _ = closed_loop(
        Mpc(route=circle(2.0), parameters=MpcParameters(**tight, horizon=40)), start, seconds
    )
    b, _, _ = closed_loop(
        Tvlqr(route=circle(2.0), parameters=TvlqrParameters(**tight)), start, seconds
    )

    def squared(poses: np.ndarray) -> float:
        off = np.hypot(poses[:, 0], poses[:, 1] - 2.0) - 2.0
        return float((off * off).mean())

    assert squared(a) < 0.9 * squared(b)


def test_a_horizon_must_be_a_number_of_commands() -> None:
    with pytest.raises(ValueError, match="horizon"):
        MpcParameters(horizon=0)


def test_from_rest_beside_the_route_it_joins_without_overshoot() -> None:
    """Who knows how slowly it can turn begins to turn back in time."""
    slow = MpcParameters(max_acceleration=0.3, max_turn_acceleration=2.0)
    poses, commands, _ = closed_loop(
        Mpc(route=straight(length=6.0, v=0.5), parameters=slow), (0.0, 0.13, 0.0), 9.0
    )
    assert poses[:, 1].min() > -0.015
    assert np.abs(poses[600:, 1]).max() < 0.005
    assert np.diff(commands[:, 0]).max() <= 0.3 * 0.05 + 1e-9
