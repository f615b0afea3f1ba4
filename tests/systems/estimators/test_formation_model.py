"""Bearings and distances of markers on robots: known answers, other implementations, noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.autodiffutils import InitializeAutoDiff
from pydrake.math import atan2, cos, log, sin, sqrt

from systems.estimators.formation_model import (
    Layout,
    Sightings,
    jacobian,
    mean_values,
    measure,
    predict,
    residuals,
    variances,
)
from systems.messages import Detections
from tests.formation_world import CAMERA, FRONT_AND_REAR, OFFSET, SIZE, FormationWorld

LAYOUT = Layout(4, FRONT_AND_REAR, OFFSET)
SOME = Sightings(
    np.array([0, 3, 2, 1, 3]),
    np.array([0, 1, 1, 0, 0]),
    np.array([4, 1, 14, 11, 8]),
    np.zeros((5, 2)),
)


def some_state() -> np.ndarray:
    random = np.random.default_rng(3)
    poses = random.uniform(-2, 2, (4, 3))
    return np.concatenate([poses.ravel(), random.normal(0, 0.05, 8)])


def test_known_sightings() -> None:
    """Robot 0 in the origin looks east; robot 1, 2 m ahead and 2 m to the left, shows its right."""
    x = np.zeros(LAYOUT.size)
    x[3:6] = 2.0, 2.15, 0.0
    seen = Sightings(np.array([0, 0]), np.array([0, 1]), np.array([7, 7]), np.zeros((2, 2)))
    expected = [math.pi / 4, math.log(math.sqrt(8))], [-3 * math.pi / 4, math.log(math.sqrt(8))]
    np.testing.assert_allclose(predict(LAYOUT, x, seen), expected, atol=1e-12)
    x[LAYOUT.poses] = 0.1  # the front camera of robot 0 looks more to the left than it is said to
    np.testing.assert_allclose(predict(LAYOUT, x, seen)[0, 0], math.pi / 4 - 0.1, atol=1e-12)


def test_jacobian_is_that_of_autodiff() -> None:
    x = some_state()
    states = InitializeAutoDiff(x).ravel()
    J = jacobian(LAYOUT, x, SOME)
    for n, (i, c, marker) in enumerate(zip(SOME.observer, SOME.camera, SOME.marker, strict=True)):
        j, side = divmod(int(marker), 4)
        px, py, theta = states[3 * i : 3 * i + 3]
        qx, qy, other = states[3 * j : 3 * j + 3]
        angle = other + side * math.pi / 2
        dx, dy = qx + OFFSET * cos(angle) - px, qy + OFFSET * sin(angle) - py
        bearing = atan2(dy, dx) - theta - c * math.pi - states[12 + 2 * i + c]
        distance = log(sqrt(dx * dx + dy * dy))
        np.testing.assert_allclose(J[n, 0], bearing.derivatives(), atol=1e-12)
        np.testing.assert_allclose(J[n, 1], distance.derivatives(), atol=1e-12)
        value = predict(LAYOUT, x, SOME)[n]
        assert math.remainder(value[0] - bearing.value(), 2 * math.pi) == pytest.approx(
            0, abs=1e-12
        )
        assert value[1] == pytest.approx(distance.value(), abs=1e-12)


def test_residuals_do_not_jump_at_half_a_turn() -> None:
    x = some_state()
    values = predict(LAYOUT, x, SOME) + np.array([2 * math.pi - 0.01, 0.02])
    r = residuals(LAYOUT, x, SOME._replace(values=values))
    np.testing.assert_allclose(r, np.tile([-0.01, 0.02], (5, 1)), atol=1e-12)


def test_corners_without_noise_give_what_the_model_predicts() -> None:
    """Through the pinhole, at all angles, with yaw errors: two ways that share no line."""
    total = 0
    for seed in range(5):
        world = FormationWorld(seed=seed, start_noise=(0.2, 0.3), yaw_error=0.02)
        x = np.concatenate([world.poses.ravel(), world.yaw_errors.ravel()])
        for i in range(4):
            for c in range(2):
                found = world.detections(i, c, 0.0)
                n = len(found)
                values = measure(found, CAMERA, SIZE)
                seen = Sightings(np.full(n, i), np.full(n, c), found.ids, values)
                np.testing.assert_allclose(residuals(LAYOUT, x, seen), 0.0, atol=1e-9)
                total += n
    assert total > 20


def test_corner_noise_gives_the_variances_that_are_promised() -> None:
    world = FormationWorld(corner_noise=0.5, yaw_error=0.0, start_noise=(1e-9, 1e-9))
    exact = FormationWorld(yaw_error=0.0, start_noise=(1e-9, 1e-9))
    true = measure(exact.detections(3, 1, 0.0), CAMERA, SIZE)
    errors = np.array(
        [measure(world.detections(3, 1, 0.0), CAMERA, SIZE) - true for _ in range(2000)]
    )
    noise = np.array([0.5, 0, 0, 0])
    said = variances(true, np.ones(len(true)), focal_length=485.0, marker_size=SIZE, noise=noise)
    assert len(true) >= 3
    ratio = errors.var(axis=0) / said
    # By hand, of a marker of width w and height h: (1 + (w / h)^2) / 1.5 in the bearing.
    corners = exact.detections(3, 1, 0.0).corners
    width, height = np.ptp(corners[..., 0], axis=1), np.ptp(corners[..., 1], axis=1)
    np.testing.assert_allclose(ratio[:, 0], (1 + (width / height) ** 2) / 1.5, rtol=0.12)
    np.testing.assert_allclose(ratio[:, 1], 1.0, atol=0.1)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=2e-3)


def test_means_over_pictures_lose_the_white_noise_only() -> None:
    values = np.array([[0.1, math.log(1.5)]])
    noise = np.array([0.5, 0.0, 0.001, 0.003])
    terms = {"focal_length": 485.0, "marker_size": SIZE}
    one, many = (variances(values, np.array([float(n)]), **terms, noise=noise)[0] for n in (1, 100))
    floor = np.square([0.001, 0.003])
    np.testing.assert_allclose((one - floor) / (many - floor), 100.0)
    # What of it no mean takes away is as large as noise that nobody has taken means of.
    lasting = variances(values, np.array([1e9]), **terms, noise=np.array([0.5, 0.2, 0.001, 0.003]))
    np.testing.assert_allclose((lasting[0] - floor) / (one - floor), (0.2 / 0.5) ** 2, rtol=1e-6)


def test_what_lasts_of_corners_makes_far_distances_doubtful() -> None:
    """0.1 px of 485 px x 0.16 m at 1 and at 4 m, by hand; of the bearing it is the same."""
    values = np.array([[0.0, 0.0], [0.0, math.log(4.0)]])
    terms = {"focal_length": 485.0, "marker_size": SIZE, "noise": np.array([0, 0.1, 0, 0])}
    bearing, distance = np.sqrt(variances(values, np.ones(2), **terms)).T
    np.testing.assert_allclose(distance, 0.1 / (485.0 * SIZE) * np.array([1.0, 4.0]))
    np.testing.assert_allclose(bearing, 0.1 * math.sqrt(1.5) / 2 / 485.0)


def test_distances_of_small_markers_are_right_in_the_mean() -> None:
    """12 px high, noise of 0.6 px: a mean of logarithms is too far, that of depths more still."""
    rng = np.random.default_rng(3)
    high = 12.0
    size = 4.0 * high / CAMERA.K[0, 0]  # 4 m ahead
    u, v = CAMERA.K[0, 2], CAMERA.K[1, 2]
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * high / 2 + [u, v]
    markers, frames = 200, 100
    noisy = square + rng.normal(0.0, 0.6, (frames, markers, 4, 2))
    ids = np.arange(markers)
    pictures = [measure(Detections(ids=ids, corners=each), CAMERA, size) for each in noisy]
    mean = np.full((markers, 2), 7.0)  # of no picture yet: does not matter
    for k, values in enumerate(pictures):
        mean = mean_values(mean, values, np.full(markers, k + 1.0))
    said = np.exp(mean[:, 1]).mean() / 4.0
    assert abs(said - 1.0) < 1e-3  # three times the standard deviation of the mean
    assert np.exp(np.mean(pictures, axis=0)[:, 1]).mean() / 4.0 > 1.001
    heights = noisy[..., 3, 1] - noisy[..., 0, 1], noisy[..., 2, 1] - noisy[..., 1, 1]
    assert np.mean([high / each for each in heights]) > 1.004
    np.testing.assert_allclose(mean[:, 0], np.mean(pictures, axis=0)[:, 0], atol=1e-12)


def test_corners_that_make_no_upright_marker_are_not_measured() -> None:
    world = FormationWorld(start_noise=(1e-9, 1e-9))
    found = world.detections(3, 1, 0.0)
    corners = found.corners.copy()
    corners[0] = corners[0, ::-1]  # upside down
    corners[1] = 100.0  # all in one point
    corners[2, 0, 0] = math.nan
    spoilt = type(found)(stamp=0.0, ids=found.ids, corners=corners)
    assert np.isnan(measure(spoilt, CAMERA, SIZE)[:3]).all()
    assert measure(type(found)(), CAMERA, SIZE).shape == (0, 2)
