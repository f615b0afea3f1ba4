from __future__ import annotations

import math

import numpy as np
import pytest

from systems.controllers.pure_pursuit import (
    PurePursuit,
    PurePursuitParameters,
    curvature_to,
    lookahead,
    target,
)
from tests.systems.controllers.tracking import circle, closed_loop, straight


@pytest.mark.parametrize("radius", [0.5, 2.0, -1.0])
def test_the_arc_to_a_point_of_a_circle_is_that_circle(radius: float) -> None:
    for angle in (0.1, 0.7, 2.0):
        a = angle * np.sign(radius)
        point = radius * np.array([math.sin(a), 1 - math.cos(a)])
        assert curvature_to(point) == pytest.approx(1 / radius)


def test_a_point_straight_ahead_or_underfoot_asks_for_no_turn() -> None:
    assert curvature_to(np.array([2.0, 0.0])) == 0.0
    assert curvature_to(np.array([0.0, 0.0])) == 0.0


def test_it_looks_farther_the_faster_it_goes_within_bounds() -> None:
    p = PurePursuitParameters(look_time=0.5, min_look=0.2, max_look=0.6)
    assert [lookahead(v, p) for v in (0.1, 0.8, 3.0)] == pytest.approx([0.2, 0.4, 0.6])


def test_the_target_lies_ahead_along_the_route() -> None:
    route = circle(1.0)
    x, y = target(route, route.duration - 0.1, 0.04 + math.pi / 2)
    np.testing.assert_allclose([x, y], [1.0, 1.0], atol=1e-4)
    np.testing.assert_allclose(target(straight(2.0), 4.5, 0.5), [2.3, 0.0], atol=1e-9)


def test_an_offset_from_a_straight_line_dies_out_as_the_lookahead_says() -> None:
    # For small offsets omega = -2 v y / L^2 - 2 v theta / L: damping 1 / sqrt(2), and
    # y = y0 exp(-s / L) (cos(s / L) + sin(s / L)) after a way s.
    p = PurePursuitParameters(look_time=0.5, min_look=0.4, max_look=0.4, max_turn_acceleration=1e3)
    poses, _, _ = closed_loop(
        PurePursuit(route=straight(), parameters=p, rate=100.0), (0.0, 0.02, 0.0), 6.0
    )
    s = poses[:, 0] / 0.4
    expected = 0.02 * np.exp(-s) * (np.cos(s) + np.sin(s))
    np.testing.assert_allclose(poses[:, 1], expected, atol=4e-4)


@pytest.mark.parametrize("changes", [{"min_look": 0.9}, {"look_time": 0.0}, {"max_look": math.inf}])
def test_bad_lookaheads_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="look"):
        PurePursuitParameters(**changes)
