from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RotationMatrix
from scipy.spatial.transform import Rotation

from systems.shell.angles import (
    angle_differences,
    angles_defined,
    angles_of,
    nearest_rotation,
    one_rotation,
    rotation,
    rotation_error,
    rotation_vector,
    upright,
)

DEG = math.radians(1.0)
UP = np.array([0.0, 0.0, 1.0])


def anywhere(n: int, seed: int = 0) -> np.ndarray:
    """[roll, pitch, yaw] all over the sphere, but for the last 0.1 degrees at the poles."""
    rng = np.random.default_rng(seed)
    bounds = np.array([np.pi, np.pi / 2 - 0.1 * DEG, np.pi])
    return rng.uniform(-bounds, bounds, (n, 3))


def by_drake(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """The definition, with Drake's elementary rotations."""
    R_0 = RotationMatrix(np.column_stack([(0.0, 0, 1), (0, -1, 0), (1, 0, 0)]))
    product = (
        RotationMatrix.MakeZRotation(yaw)
        @ RotationMatrix.MakeYRotation(-pitch)
        @ RotationMatrix.MakeXRotation(roll)
        @ R_0
    )
    return product.matrix()


@pytest.mark.parametrize(
    ("degrees", "forward", "left", "up"),
    [
        ((0, 0, 0), (0, 0, 1), (0, -1, 0), (1, 0, 0)),  # at yaw 0 the east is +y: left is west
        ((90, 0, 0), (0, -1, 0), (0, 0, -1), (1, 0, 0)),
        ((0, 0, 90), (0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((0, 90, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1)),  # over the top, on toward yaw 180
        ((180, 0, 180), (0, 0, -1), (0, -1, 0), (-1, 0, 0)),  # and down there: left has stayed
    ],
)
def test_the_axes_are_where_one_would_point(
    degrees: tuple[float, ...],
    forward: tuple[float, ...],
    left: tuple[float, ...],
    up: tuple[float, ...],
) -> None:
    R = rotation(np.radians(degrees))
    np.testing.assert_allclose(R, np.column_stack([forward, left, up]), atol=1e-15)


def test_rotations_are_those_of_the_definition_and_angles_their_inverse() -> None:
    angles = anywhere(500)
    R = rotation(angles)
    np.testing.assert_allclose(R, [by_drake(*a) for a in angles], atol=1e-14)
    np.testing.assert_allclose(angles_of(R), angles, atol=1e-12)
    # The normal is at latitude pitch and longitude yaw; roll is the heading left of the pole.
    np.testing.assert_allclose(np.arcsin(R[:, 2, 2]), angles[:, 1], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(R[:, 1, 2], R[:, 0, 2]), angles[:, 2], atol=1e-12)
    to_pole = np.einsum("nji,j->ni", R, UP)  # the pole as the robot sees it
    np.testing.assert_allclose(np.arctan2(-to_pole[:, 1], to_pole[:, 0]), angles[:, 0], atol=1e-9)


def test_leading_axes_are_kept() -> None:
    angles = anywhere(6)
    R = rotation(angles.reshape(2, 3, 3))
    assert R.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(R.reshape(6, 3, 3), rotation(angles))
    np.testing.assert_array_equal(angles_of(R).reshape(6, 3), angles_of(R.reshape(6, 3, 3)))
    np.testing.assert_array_equal(rotation(angles[4]), rotation(angles)[4])
    assert rotation_vector(R).shape == (2, 3, 3)
    assert angles_defined(R).shape == (2, 3)


def test_upright_is_the_frame_of_east_and_pole() -> None:
    pitch, yaw = 0.4, -2.0
    R = upright(pitch, yaw)
    normal = np.array(
        [math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)]
    )
    east = np.cross(UP, normal) / math.cos(pitch)
    np.testing.assert_allclose(
        R, np.column_stack([normal, east, np.cross(normal, east)]), atol=1e-14
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_at_a_pole_roll_is_zero_and_the_rotation_is_kept(sign: int) -> None:
    for roll, yaw in np.random.default_rng(1).uniform(-3, 3, (20, 2)):
        R = by_drake(roll, sign * np.pi / 2, yaw)
        found = angles_of(R)
        assert found[0] == 0.0
        assert found[1] == pytest.approx(sign * np.pi / 2, abs=1e-9)
        assert math.remainder(found[2] - (yaw + sign * roll), 2 * np.pi) == pytest.approx(
            0, abs=1e-9
        )
        np.testing.assert_allclose(rotation(found), R, atol=1e-9)


def test_near_a_pole_the_rotation_is_kept_whatever_the_angles() -> None:
    for off in 10.0 ** -np.arange(1, 17):
        R = by_drake(0.7, np.pi / 2 - off, 2.0)
        np.testing.assert_allclose(rotation(angles_of(R)), R, atol=2e-9)


def test_angles_are_defined_outside_a_margin_about_both_poles() -> None:
    pitch = np.radians([-89.0, -81.0, -79.0, 0.0, 79.0, 81.0, 90.0])
    R = rotation(np.stack([0 * pitch + 0.3, pitch, 0 * pitch + 1.0], axis=1))
    assert angles_defined(R).tolist() == [False, False, True, True, True, False, False]
    assert angles_defined(R, margin=2 * DEG).tolist() == [
        False,
        True,
        True,
        True,
        True,
        True,
        False,
    ]


def test_rotation_vectors_are_scipys_at_every_angle() -> None:
    rng = np.random.default_rng(2)
    axes = rng.normal(size=(400, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate(
        [
            rng.uniform(0, np.pi, 200),
            10.0 ** rng.uniform(-12, -1, 100),
            np.pi - 10.0 ** rng.uniform(-9, -1, 100),
        ]
    )
    vectors = angles[:, None] * axes
    found = rotation_vector(Rotation.from_rotvec(vectors).as_matrix())
    np.testing.assert_allclose(found, vectors, atol=1e-10)
    np.testing.assert_array_equal(rotation_vector(np.eye(3)), 0.0)
    half_turns = rotation_vector(np.array([np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1])]))
    np.testing.assert_allclose(half_turns, [[np.pi, 0, 0], [0, 0, np.pi]], atol=1e-15)


def test_one_rotation_is_scipys_at_every_angle() -> None:
    rng = np.random.default_rng(5)
    for angle in (0.0, 1e-12, 1e-5, 0.99e-4, 1.01e-4, 1e-3, 0.1, 1.0, 3.0, np.pi, 6.0):
        axis = rng.standard_normal(3)
        w = angle * axis / np.linalg.norm(axis)
        R = one_rotation(w)
        np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), rtol=0, atol=4e-15)


def test_the_error_is_a_rotation_in_the_spheres_frame() -> None:
    truth = rotation(anywhere(50))
    phi = np.random.default_rng(3).uniform(-1, 1, (50, 3))
    estimate = Rotation.from_rotvec(phi).as_matrix() @ truth
    np.testing.assert_allclose(rotation_error(estimate, truth), phi, atol=1e-12)
    assert np.abs(rotation_error(truth, estimate) - phi).max() > 0.1  # the order matters
    in_body = Rotation.from_matrix(np.swapaxes(truth, 1, 2) @ estimate).as_rotvec()
    assert np.abs(in_body - phi).max() > 0.1  # and so does the frame


def test_angle_differences_are_wrapped() -> None:
    a = rotation(np.radians([179.0, 10.0, -179.0]))
    b = rotation(np.radians([-179.0, 12.0, 178.0]))
    np.testing.assert_allclose(np.degrees(angle_differences(a, b)), [-2.0, -2.0, 3.0], atol=1e-9)


def test_beside_the_pole_a_small_error_is_a_large_difference_of_angles() -> None:
    # Why errors are rotation vectors: 1 degree of error, 1 degree from the pole.
    truth = rotation(np.radians([0.0, 89.0, 0.0]))
    estimate = Rotation.from_rotvec([1 * DEG, 0, 0]).as_matrix() @ truth
    assert np.linalg.norm(rotation_error(estimate, truth)) == pytest.approx(1 * DEG)
    difference = np.degrees(angle_differences(estimate, truth))
    assert difference[2] == pytest.approx(-45.0, abs=0.1)
    assert difference[0] == pytest.approx(45.0, abs=0.1)


def test_a_bent_rotation_is_straightened() -> None:
    R = rotation(anywhere(20))
    bent = R + np.random.default_rng(4).normal(0, 1e-7, R.shape)
    straight = nearest_rotation(bent)
    np.testing.assert_allclose(
        np.swapaxes(straight, 1, 2) @ straight, np.tile(np.eye(3), (20, 1, 1)), atol=1e-12
    )
    for found, given in zip(straight, bent, strict=True):
        np.testing.assert_allclose(
            found, RotationMatrix.ProjectToRotationMatrix(given).matrix(), atol=1e-12
        )
