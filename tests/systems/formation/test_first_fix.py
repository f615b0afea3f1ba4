"""A pose from one picture of two robots: by hand, with noise, and with robots mixed up."""

import math

import numpy as np
import pytest

from systems.formation.axes import marker_centres
from systems.formation.bearings import in_robot
from systems.formation.first_fix import marker_centre, place_in_robot, pose_by_places

POSE = np.array([0.4, -0.3, 0.7])
# Faces that look at the robot, as far as they can.
ROBOTS = np.array([[1.9, 0.2, 0.0], [1.5, 1.6, 0.0]])
FACES = np.array([math.pi, -math.pi / 2])
CENTRES = np.array([marker_centres(ROBOTS[0], 0.15)[2], marker_centres(ROBOTS[1], 0.15)[3]])


def corners(forward: float, left: float, size: float, rear: bool) -> np.ndarray:
    """A marker that faces the camera squarely, as rays x/z, y/z."""
    z, x = (-forward, left) if rear else (forward, -left)
    h = size / 2
    points = np.array([[x - h, -h], [x + h, -h], [x + h, h], [x - h, h]])
    return points / z


@pytest.mark.parametrize("rear", [False, True])
def test_height_and_place_in_the_picture_give_the_place(rear: bool) -> None:
    forward = -2.0 if rear else 2.0
    rays = corners(forward, 0.5, 0.1, rear)
    assert place_in_robot(rays, 0.1, rear=rear) == pytest.approx([forward, 0.5])
    assert marker_centre(rays) == pytest.approx(0.25 if rear else -0.25)


def test_an_upside_down_marker_is_nowhere() -> None:
    assert np.isnan(
        place_in_robot(corners(2.0, 0.0, 0.1, False)[[3, 2, 1, 0]], 0.1, rear=False)
    ).all()


def test_two_places_give_the_pose() -> None:
    pose = pose_by_places(in_robot(POSE, CENTRES), CENTRES, FACES)
    np.testing.assert_allclose(pose, POSE, atol=1e-9)


def test_distances_that_err_by_a_part_move_it_by_as_much() -> None:
    seen = in_robot(POSE, CENTRES) * np.array([[1.02], [0.99]])
    pose = pose_by_places(seen, CENTRES, FACES)
    assert pose is not None
    assert 0.001 < np.hypot(*(pose[:2] - POSE[:2])) < 0.08


def test_two_robots_taken_for_each_other_are_seen_from_behind() -> None:
    assert pose_by_places(in_robot(POSE, CENTRES)[::-1], CENTRES, FACES) is None


def test_a_third_that_is_not_where_it_is_believed_to_be_spoils_it() -> None:
    more = np.vstack([CENTRES, [[0.9, 1.2]]])
    faces = np.append(FACES, -math.pi / 2)
    seen = in_robot(POSE, more)
    assert pose_by_places(seen, more, faces) is not None
    assert pose_by_places(seen, more + np.array([[0, 0], [0, 0], [0.9, 0]]), faces) is None


def test_one_place_and_two_at_one_place_are_not_enough() -> None:
    seen = in_robot(POSE, CENTRES)
    assert pose_by_places(seen[:1], CENTRES[:1], FACES[:1]) is None
    assert pose_by_places(seen[[0, 0]], CENTRES[[0, 0]], FACES[[0, 0]]) is None
