from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from systems.angles import planar_pose, spatial_pose, wrap


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (math.pi, math.pi),
        (-math.pi, math.pi),
        (3 * math.pi / 2, -math.pi / 2),
        (-3 * math.pi / 2, math.pi / 2),
        (7.0, 7.0 - 2 * math.pi),
        (1e6 + 0.25, math.remainder(1e6 + 0.25, 2 * math.pi)),
    ],
)
def test_known_angles(angle: float, wrapped: float) -> None:
    assert wrap(angle) == pytest.approx(wrapped, abs=1e-9)
    assert wrap(np.array([angle]))[0] == pytest.approx(wrapped, abs=1e-9)
    assert wrap(np.float64(angle)) == wrap(angle)


def test_any_angle_is_wrapped_into_one_turn_without_turning() -> None:
    rng = np.random.default_rng(0)
    near_pi = np.nextafter(np.pi, [0.0, 10.0])
    angles = np.concatenate([rng.uniform(-50, 50, 1000), near_pi, -near_pi, np.pi * np.arange(9)])
    wrapped = wrap(angles)
    assert (np.abs(wrapped) <= np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-13)
    one_by_one = [wrap(angle) for angle in angles.tolist()]
    np.testing.assert_allclose(one_by_one, wrapped, atol=1e-13)


def test_what_is_not_finite_stays_so() -> None:
    assert np.isnan(wrap(np.array([np.nan, 1.0]))).tolist() == [True, False]
    assert math.isnan(wrap(math.nan))


def test_planar_and_spatial_poses_are_inverse() -> None:
    rng = np.random.default_rng(1)
    for x, y, theta in rng.uniform([-5, -5, -3.1], [5, 5, 3.1], (50, 3)):
        X_WB = spatial_pose(np.array([x, y, theta]), z=0.7)
        np.testing.assert_allclose(planar_pose(X_WB), [x, y, theta], atol=1e-12)
        assert X_WB.translation()[2] == 0.7
        # Forward is where the heading points, and up stays up.
        np.testing.assert_allclose(
            X_WB.rotation().matrix() @ np.diag([1, 0, 1]),
            [[np.cos(theta), 0, 0], [np.sin(theta), 0, 0], [0, 0, 1]],
            atol=1e-12,
        )


def test_the_heading_of_a_tilted_body_is_its_yaw() -> None:
    X_WB = RigidTransform(RollPitchYaw(0.2, -0.3, 2.5), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(planar_pose(X_WB), [1.0, 2.0, 2.5], atol=1e-12)
