from __future__ import annotations

import math

import numpy as np
import pytest

from systems.planners.closed_curve import ClosedCurve

ANGLES = np.linspace(0, 2 * math.pi, 24, endpoint=False)
CIRCLE = ClosedCurve(2.0 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1))


def test_a_circle_by_hand() -> None:
    assert CIRCLE.length == pytest.approx(4 * math.pi, rel=1e-4)
    np.testing.assert_allclose(np.hypot(*CIRCLE.positions.T), 2.0, atol=1e-4)
    np.testing.assert_allclose(CIRCLE.curvatures, 0.5, rtol=1e-2)
    position, heading = CIRCLE.at(math.pi)  # a quarter of it
    np.testing.assert_allclose(position, [0.0, 2.0], atol=1e-3)
    assert heading == pytest.approx(math.pi, abs=1e-3)
    # Clockwise it turns to the right.
    np.testing.assert_allclose(ClosedCurve(CIRCLE.positions[::-10]).curvatures, -0.5, rtol=1e-2)


def test_it_goes_round() -> None:
    for s in (0.3, 5.0):
        here, heading = CIRCLE.at(s)
        again, turned = CIRCLE.at(s + CIRCLE.length)
        np.testing.assert_allclose(again, here, atol=1e-12)
        assert heading == pytest.approx(turned)
    before, after = (CIRCLE.at(s)[0] for s in (-1e-3, 1e-3))
    assert np.hypot(*(after - before)) == pytest.approx(2e-3, rel=1e-3)


def test_it_passes_its_points_smoothly() -> None:
    points = np.array([[0, 0], [2, -0.5], [3, 1], [1.5, 2.2], [-0.5, 1.4]], float)
    curve = ClosedCurve(points)
    assert curve.distances(points).max() < 0.005
    np.testing.assert_allclose(curve.positions[0], points[0], atol=1e-12)
    step = curve.length / len(curve.s)
    ahead = np.roll(curve.positions, -1, axis=0) - curve.positions
    np.testing.assert_allclose(np.hypot(*ahead.T), step, rtol=1e-3)
    # Headings and curvatures are the derivatives of what is there.
    middle = np.roll(np.unwrap(curve.headings), -1)[:-1] - np.unwrap(curve.headings)[:-1]
    mean = (curve.curvatures[1:] + curve.curvatures[:-1]) / 2
    np.testing.assert_allclose(middle / step, mean, atol=0.02)
    chord = np.arctan2(ahead[:, 1], ahead[:, 0])
    turn = np.angle(np.exp(1j * (chord - curve.headings)))
    np.testing.assert_allclose(turn[:-1], middle / 2, atol=2e-3)


def test_the_nearest_place() -> None:
    assert CIRCLE.nearest([0.0, 3.0]) == pytest.approx(math.pi, abs=0.01)
    assert CIRCLE.nearest([1.5, -0.01]) == pytest.approx(CIRCLE.length - 0.0133, abs=0.011)
    # Who follows it looks near where it was: at most a metre away.
    assert CIRCLE.nearest([0.0, 1.9], around=2 * math.pi) == pytest.approx(
        2 * math.pi - 1.0, abs=0.02
    )
    np.testing.assert_allclose(CIRCLE.distances([[0, 0], [2, 0], [0, 3]]), [2, 0, 1], atol=1e-4)
    np.testing.assert_allclose(CIRCLE.curvature_at([0.0, 7.0, 100.0]), 0.5, rtol=1e-2)


def test_bad_points() -> None:
    for points in ([[0, 0], [1, 0]], [[0, 0, 0], [1, 0, 0], [1, 1, 0]], [1, 2, 3]):
        with pytest.raises(ValueError, match="points is"):
            ClosedCurve(points)
    with pytest.raises(ValueError, match="no two neighbours at one place"):
        ClosedCurve([[0, 0], [1, 0], [1, 0], [0, 1]])
    with pytest.raises(ValueError, match="no two neighbours at one place"):
        ClosedCurve([[0, 0], [1, 0], [0, 1], [0, 0]])
    with pytest.raises(ValueError, match="finite"):
        ClosedCurve([[0, 0], [1, math.nan], [0, 1]])
    with pytest.raises(ValueError, match="step is 0"):
        ClosedCurve([[0, 0], [1, 0], [0, 1]], step=0)
