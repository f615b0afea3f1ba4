from __future__ import annotations

import math

import numpy as np
import pytest

from systems.planners.path_spline import PathSpline, fit, third_differences


def ring(radius: float, n: int = 200) -> np.ndarray:
    a = 2 * math.pi * np.arange(n) / n
    return radius * np.column_stack([np.cos(a), np.sin(a)])


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_ring_of_points_becomes_a_circle(way: float) -> None:
    spline = fit(ring(2.0) * [1.0, way], True, 0.3, 1e-3)
    u, run = spline.table(0.01)
    assert run[-1] == pytest.approx(4 * math.pi, rel=1e-4)
    np.testing.assert_allclose(np.linalg.norm(spline.at(u), axis=1), 2.0, atol=1e-3)
    np.testing.assert_allclose(spline.curvature(u), way * 0.5, atol=2e-3)
    np.testing.assert_allclose(spline.at(u[[0]]), spline.at(u[[-1]]), atol=1e-12)


def test_the_table_goes_along_in_equal_steps() -> None:
    rng = np.random.default_rng(0)
    spline = PathSpline(np.cumsum(rng.uniform(0, 1, (12, 2)), axis=0), False)
    u, run = spline.table(0.05)
    gone = np.linalg.norm(np.diff(spline.at(u), axis=0), axis=1)
    np.testing.assert_allclose(gone, np.diff(run), rtol=0.01)


@pytest.mark.parametrize("closed", [True, False])
def test_derivatives_are_those_of_finite_differences(closed: bool) -> None:
    control = np.random.default_rng(1).uniform(-1, 1, (9, 2))
    spline = PathSpline(control, closed)
    u, h = np.linspace(0.31, spline.pieces - 0.37, 23), 1e-5
    for order in (0, 1):
        slope = (spline.at(u + h, order) - spline.at(u - h, order)) / (2 * h)
        np.testing.assert_allclose(spline.at(u, order + 1), slope, atol=1e-6)
    # The second one is continuous where pieces meet.
    whole = np.arange(1.0, spline.pieces)
    np.testing.assert_allclose(spline.at(whole - 1e-9, 2), spline.at(whole, 2), atol=1e-6)
    np.testing.assert_allclose(spline.weights(u).sum(axis=1), 1.0)


def test_stiffness_smooths_noise_away() -> None:
    noisy = ring(2.0) + np.random.default_rng(2).normal(0, 0.01, (200, 2))
    rough, smooth = (fit(noisy, True, 0.3, stiffness) for stiffness in (1e-6, 1.0))
    u, _ = rough.table(0.05)
    bends = [np.abs(spline.curvature(u) - 0.5).max() for spline in (rough, smooth)]
    assert bends[1] < 0.5 * bends[0]


def test_a_parabola_of_control_points_has_no_third_difference() -> None:
    k = np.arange(10.0)
    spline = PathSpline(np.column_stack([k, 0.3 * k * k]), False)
    np.testing.assert_allclose(third_differences(spline) @ spline.control, 0.0, atol=1e-12)
