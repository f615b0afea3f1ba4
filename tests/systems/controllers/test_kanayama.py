from __future__ import annotations

import math

import numpy as np
import pytest

from systems.controllers.kanayama import KanayamaParameters, track
from systems.controllers.path_tracking import driven, error_of

P = KanayamaParameters(k_x=2.0, k_y=25.0, k_theta=10.0)


def test_the_command_is_equation_8() -> None:
    # 0.4 cos 0.3 + 2 0.1, and 0.2 + 0.4 (25 (-0.05) + 10 sin 0.3).
    command = track(np.array([0.1, -0.05, 0.3]), np.array([0.4, 0.2]), P)
    np.testing.assert_allclose(command, [0.5821346, 0.8820808], atol=1e-7)


def test_a_mirrored_error_turns_the_other_way() -> None:
    left = track(np.array([0.1, 0.2, -0.3]), np.array([0.4, 0.2]), P)
    right = track(np.array([0.1, -0.2, 0.3]), np.array([0.4, -0.2]), P)
    np.testing.assert_allclose(right, left * [1, -1])


def drive(start: np.ndarray, omega: float, seconds: float, dt: float = 1e-3) -> np.ndarray:
    """Errors while a robot follows a reference that drives 0.4 m/s and omega."""
    robot, reference = start, np.zeros(3)
    errors = []
    for _ in range(round(seconds / dt)):
        errors.append(error_of(reference, robot))
        robot = driven(robot, track(errors[-1], np.array([0.4, omega]), P), dt)
        reference = driven(reference, np.array([0.4, omega]), dt)
    return np.array(errors)


@pytest.mark.parametrize("omega", [0.0, 0.5, -0.8])
def test_lyapunovs_function_falls_from_wherever_it_starts(omega: float) -> None:
    for start in np.random.default_rng(1).uniform(-1, 1, (5, 3)) * [0.8, 0.8, 2.5]:
        e = drive(start, omega, 20.0)
        # Proposition 1: V = (x^2 + y^2) / 2 + (1 - cos theta) / k_y.
        V = (e[:, 0] ** 2 + e[:, 1] ** 2) / 2 + (1 - np.cos(e[:, 2])) / P.k_y
        assert np.diff(V).max() < 1e-5 * V[0]
        assert V[-1] < 1e-6 * V[0]


def test_a_small_offset_dies_out_as_the_gains_say() -> None:
    # Critically damped: y = y0 (1 + w t) exp(-w t), w = v sqrt(k_y) = 2 /s.
    e = drive(np.array([0.0, 0.01, 0.0]), 0.0, 3.0)
    t = 1e-3 * np.arange(len(e))
    np.testing.assert_allclose(e[:, 1], -0.01 * (1 + 2 * t) * np.exp(-2 * t), atol=2e-5)


@pytest.mark.parametrize("name", ["k_x", "k_y", "k_theta"])
def test_gains_must_be_positive(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        KanayamaParameters(**{name: -1.0})
    with pytest.raises(ValueError, match=name):
        KanayamaParameters(**{name: math.inf})
