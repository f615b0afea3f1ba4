import math

import numpy as np
import pytest
from scipy.optimize import approx_fprime, least_squares

from systems.formation.bearings import (
    bearing,
    cramer_rao,
    in_robot,
    lateral_pixels,
    pixel_covariance,
    resect,
)
from systems.formation.triangles import arrival_heading, components, next_vertex

F = 485.0
BEACONS = np.array([[2.25, 0.0], [1.5, 1.3], [0.75, 0.0]])
VERTEX = next_vertex(BEACONS)
HEADING = float(arrival_heading(VERTEX, BEACONS[2]))
POSE = np.array([*VERTEX, HEADING])
EXACT = pixel_covariance(3, 0.5, 0.0)


def test_at_the_vertex_the_side_beacons_are_280_px_from_the_anchor() -> None:
    u = lateral_pixels(POSE, BEACONS, F)[0]
    assert u == pytest.approx([-280, 280, 0], abs=0.5)


def test_the_picture_behind_has_the_robots_left_on_its_right() -> None:
    robot = np.zeros(3)
    u = lateral_pixels(robot, np.array([[-1.0, 0.5], [1.0, 0.5]]), F)[0]
    assert u == pytest.approx([F / 2, -F / 2])
    assert bearing(u[0], F, backward=True) == pytest.approx(math.atan2(0.5, -1.0))
    assert bearing(u[1], F) == pytest.approx(math.atan2(0.5, 1.0))


def test_pixels_and_bearings_agree_for_any_pose() -> None:
    random = np.random.default_rng(0)
    poses = np.column_stack([random.uniform(-3, 3, (100, 2)), random.uniform(-3, 3, 100)])
    p_B = in_robot(poses, BEACONS)
    u = lateral_pixels(poses, BEACONS, F)[0]
    direction = np.where(p_B[..., 0] > 0, bearing(u, F), bearing(u, F, backward=True))
    assert np.exp(1j * direction) == pytest.approx(
        np.exp(1j * np.arctan2(p_B[..., 1], p_B[..., 0]))
    )


def test_derivatives_against_differences() -> None:
    jacobian = lateral_pixels(POSE, BEACONS, F)[1]
    numeric = approx_fprime(POSE, lambda x: lateral_pixels(x, BEACONS, F)[0], 1e-7)
    assert jacobian == pytest.approx(numeric, abs=1e-3)


def test_the_bound_is_the_issues() -> None:
    bound = cramer_rao(POSE, BEACONS, F, EXACT)
    c, s = math.cos(HEADING), math.sin(HEADING)
    axes = np.array([[c, s], [-s, c]]) @ bound[:2, :2] @ np.array([[c, -s], [s, c]])
    assert np.sqrt(np.diag(axes)) == pytest.approx([1.6e-3, 6.1e-3], abs=0.05e-3)


def test_one_picture_reaches_the_bound_and_says_so() -> None:
    random = np.random.default_rng(1)
    u = lateral_pixels(POSE, BEACONS, F)[0] + random.normal(0, 0.5, (5000, 3))
    found = resect(u, BEACONS, F, EXACT, POSE + np.array([0.1, -0.1, 0.1]))
    error = found.pose - POSE
    along, aside = components(error[:, :2], HEADING)
    assert np.std(aside) <= 1.05 * 6.07e-3
    assert np.std(along) <= 1.05 * 1.64e-3
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    assert nees.mean() == pytest.approx(3.0, abs=0.15)


def test_more_than_three_are_solved_as_scipy_does() -> None:
    beacons = np.vstack([BEACONS, [[1.2, 0.9], [0.9, -0.3]]])
    random = np.random.default_rng(2)
    u = lateral_pixels(POSE, beacons, F)[0] + random.normal(0, 2.0, 5)
    found = resect(u, beacons, F, pixel_covariance(5, 2.0, 0.0), POSE + 0.05)
    other = least_squares(lambda x: lateral_pixels(x, beacons, F)[0] - u, POSE, xtol=1e-14)
    assert found.pose == pytest.approx(other.x, abs=1e-6)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_it_finds_the_pose_from_afar_and_in_the_mirror(mirror: float) -> None:
    flip = np.array([1.0, mirror])
    pose = POSE * [1.0, mirror, mirror]
    u = lateral_pixels(pose, BEACONS * flip, F)[0]
    found = resect(u, BEACONS * flip, F, EXACT, pose + np.array([0.4, -0.3, 0.2]))
    assert found.pose == pytest.approx(pose, abs=1e-8)


def test_a_centre_of_3_px_costs_8_mm_aside_and_is_in_the_covariance() -> None:
    u = lateral_pixels(POSE, BEACONS, F)[0] + 3.0
    found = resect(u, BEACONS, F, pixel_covariance(3, 0.5, 3.0, frames=10**6), POSE)
    along, aside = components(found.pose[:2] - POSE[:2], HEADING)
    assert abs(aside) == pytest.approx(8.0e-3, abs=0.3e-3)
    assert abs(along) < 0.5e-3
    # The covariance's one large direction is that very error.
    values, vectors = np.linalg.eigh(found.covariance)
    assert abs(vectors[:, -1] @ (found.pose - POSE)) == pytest.approx(values[-1] ** 0.5, rel=0.05)


def test_no_pose_where_there_is_none() -> None:
    u = lateral_pixels(POSE, BEACONS, F)[0]
    two = resect(u[:2], BEACONS[:2], F, pixel_covariance(2, 0.5, 0.0), POSE)
    assert np.isnan(two.pose).all()
    assert np.isnan(two.covariance).all()
    # On the circle through the three, every place of it explains the picture.
    angles = np.radians([150.0, 180.0, 210.0])
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    on_it = np.array([1.0, 0.0, 0.0])
    found = resect(lateral_pixels(on_it, circle, F)[0], circle, F, EXACT, on_it)
    assert np.isnan(found.pose).all()
    assert np.isnan(resect(u * np.nan, BEACONS, F, EXACT, POSE).pose).all()


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="pixel_std is 0"):
        pixel_covariance(3, 0.0, 0.0)
    with pytest.raises(ValueError, match="centre_std is -1"):
        pixel_covariance(3, 0.5, -1.0)
