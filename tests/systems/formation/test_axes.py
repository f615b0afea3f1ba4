import math

import numpy as np
import pytest

from systems.formation.axes import (
    axes_by_robot,
    axis_of_known_face,
    axis_of_marker,
    beacon_axes,
    marker_centres,
    robot_of,
)
from tests.triangle_step import CAMERA, World, picture

FOCAL = 485.0
SIZE, DISTANCE = 0.10, 0.15
SETBACK = DISTANCE / SIZE


def marker(turn: float, right: float, ahead: float, up: float = 0.0) -> np.ndarray:
    """Rays of a marker whose robot's axis is there, its normal `turn` to the left of the camera's.

    By hand from points in space: nothing of the code under test.
    """
    normal = np.array([-math.sin(turn), 0.0, math.cos(turn)])
    viewers_right = np.array([-math.cos(turn), 0.0, -math.sin(turn)])
    centre = np.array([right, -up, ahead]) + DISTANCE * normal
    corners = [
        centre + SIZE / 2 * (a * viewers_right + np.array([0.0, b, 0.0]))
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    return np.array([[p[0] / p[2], p[1] / p[2]] for p in corners])


TURNS = [math.radians(180 + degrees) for degrees in (-70, -45, -10, 0, 25, 60)]


@pytest.mark.parametrize("turn", TURNS)
def test_the_shape_tells_the_axis(turn: float) -> None:
    rays = marker(turn, -0.75, 1.3, up=0.04)
    place, variance = axis_of_marker(rays[None], SETBACK)
    assert place[0] == pytest.approx(-0.75 / 1.3, abs=1e-6)
    # Wrong on purpose: the marker's own centre is up to 60 px from it.
    assert variance[0] > 0


@pytest.mark.parametrize("turn", TURNS)
def test_a_known_turn_tells_the_axis_better_than_a_pixel(turn: float) -> None:
    rays = marker(turn, 0.75, 1.3, up=-0.02)
    axis = axis_of_known_face(rays[None], np.array([turn]), SETBACK)[0]
    assert abs(axis - 0.75 / 1.3) * FOCAL < 0.7  # the mean height is not quite the centre's
    centre = rays[:, 0].mean()
    assert abs(centre - 0.75 / 1.3) * FOCAL > 5 or abs(math.sin(turn - math.pi - 0.52)) < 0.3


def test_its_variance_is_that_of_the_errors() -> None:
    random = np.random.default_rng(0)
    rays = marker(math.radians(240), -0.75, 1.3)
    noisy = rays + random.normal(0, 0.1 / FOCAL, (4000, 4, 2))
    places, variances = axis_of_marker(noisy, SETBACK)
    expected = math.sqrt(variances.mean()) * 0.1 / FOCAL
    assert places.std() == pytest.approx(expected, rel=0.1)


def test_two_markers_of_one_robot_are_one_axis() -> None:
    rays = np.array([marker(math.radians(180 + a), 0.3, 1.5) for a in (-40, 50)])
    found = axes_by_robot(np.array([8, 9]), rays, SETBACK)
    assert found == {2: pytest.approx(0.2, abs=1e-6)}
    assert axes_by_robot(np.zeros(0, int), np.zeros((0, 4, 2)), SETBACK) == {}


def test_the_sides_go_round_to_the_left() -> None:
    centres = marker_centres(np.array([1.0, 2.0, math.pi / 2]), 0.15)
    assert centres == pytest.approx(np.array([[1, 2.15], [0.85, 2], [1, 1.85], [1.15, 2]]))
    assert [robot_of(k) for k in (0, 3, 4, 11)] == [0, 0, 1, 2]


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("camera_turn", [0.0, 0.02])
def test_the_beacons_of_a_picture(mirrored: bool, camera_turn: float) -> None:
    world = World(corner_noise=0.0)
    world = world.mirrored() if mirrored else world
    task = world.task()
    line = task.target - task.poses[2, :2]
    heading = math.atan2(line[1], line[0])
    pose = np.array([*task.target + 0.05 * line / np.hypot(*line), heading + camera_turn])
    seen = picture(world, pose, True, 0.0, 0, 0)
    axes = beacon_axes(
        seen.ids,
        CAMERA.undistort(seen.corners),
        task.beacons,
        task.poses[:, 2],
        2,
        heading + math.pi,
        SETBACK,
    )
    to = task.poses[:, :2] - pose[:2]
    off = np.arctan2(to[:, 1], to[:, 0]) - (pose[2] + math.pi)
    assert axes * FOCAL == pytest.approx(-np.tan(off) * FOCAL, abs=1.0)


def test_a_beacon_out_of_sight_is_nan_and_so_are_all_without_the_reference() -> None:
    rays = np.array([marker(math.radians(190), 0.3, 1.5)])
    ids, beacons, known = np.array([8]), np.array([1, 2, 3]), np.zeros(3)
    assert np.isnan(beacon_axes(ids, rays, beacons, known, 0, 0.0, SETBACK)).all()
    axes = beacon_axes(ids, rays, beacons, np.full(3, np.nan), 0, 0.0, SETBACK)
    assert axes == pytest.approx([np.nan, 0.2, np.nan], nan_ok=True, abs=1e-6)
