from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.optimize

from systems.planners.route_limits import RouteLimits
from systems.planners.speed_profile import fastest, times

LIMITS = RouteLimits(max_speed=0.5, max_acceleration=0.25, max_lateral_acceleration=0.2)


def test_along_a_straight_line_it_is_a_trapezoid() -> None:
    steps = np.full(400, 0.01)
    squared = fastest(np.zeros(401), steps, LIMITS, closed=False)
    # 0.5 m to reach 0.5 m/s, as much to stop.
    s = 0.01 * np.arange(401)
    expected = np.minimum(0.25, 0.5 * np.minimum(s, 4.0 - s))
    np.testing.assert_allclose(squared, expected, atol=1e-12)
    assert times(squared, steps, False)[-1] == pytest.approx(4.0 / 0.5 + 0.5 / 0.25, abs=1e-9)


@pytest.mark.parametrize(("radius", "speed"), [(2.0, 0.5), (0.8, 0.4), (-0.8, 0.4)])
def test_around_a_circle_it_is_constant(radius: float, speed: float) -> None:
    n = 300
    steps = np.full(n, 2 * math.pi * abs(radius) / n)
    squared = fastest(np.full(n, 1 / radius), steps, LIMITS, closed=True)
    np.testing.assert_allclose(np.sqrt(squared), speed)
    assert times(squared, steps, True)[-1] == pytest.approx(2 * math.pi * abs(radius) / speed)


def test_the_turn_rate_bounds_a_tight_bend() -> None:
    limits = RouteLimits(max_turn_rate=0.5, max_lateral_acceleration=9.0)
    squared = fastest(np.full(50, 2.0), np.full(50, 0.01), limits, closed=True)
    np.testing.assert_allclose(np.sqrt(squared), 0.25)


@pytest.mark.parametrize("closed", [True, False])
def test_no_drive_within_the_limits_is_faster_anywhere(closed: bool) -> None:
    rng = np.random.default_rng(3)
    n = 120
    kappa = np.convolve(rng.normal(0, 3, n + 20), np.ones(21) / 21, "valid")
    steps = rng.uniform(0.02, 0.06, n if closed else n - 1)
    squared = fastest(kappa, steps, LIMITS, closed)
    caps = np.minimum(0.25, np.minimum(0.2 / np.abs(kappa), (1.0 / np.abs(kappa)) ** 2))
    if not closed:
        caps[[0, -1]] = 0.0
    rise = np.roll(np.eye(n), 1, axis=1) - np.eye(n)
    rise = rise if closed else rise[:-1]
    # The largest sum of squared speeds is the largest of each: a linear program agrees.
    theirs = scipy.optimize.linprog(
        -np.ones(n), np.vstack([rise, -rise]), np.tile(2 * 0.25 * steps, 2),
        bounds=list(zip(np.zeros(n), caps, strict=True)),
    )  # fmt: skip
    np.testing.assert_allclose(squared, theirs.x, atol=1e-7)
