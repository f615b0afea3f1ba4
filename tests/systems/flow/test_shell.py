from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.flow.shell import ShellView, ShellViewParameters, back_project, inside, project
from tests.systems.flow.shell_images import CAMERA

CENTRE = CAMERA.K[:2, 2]
RADIUS, HEIGHT, F = 0.075, 0.010, 481.0
BENT = PinholeCamera(640, 480, CAMERA.K, np.array([-0.2, 0.05, 1e-3, -2e-3, 0.0]))


def pixels(n: int = 200) -> np.ndarray:
    return np.random.default_rng(1).random((n, 2)) * [639, 479]


def test_the_middle_of_the_picture_shows_the_point_below() -> None:
    view = ShellView(camera=CAMERA)
    np.testing.assert_allclose(view.back_project(CENTRE[None]), [[0, 0, RADIUS]], atol=1e-15)


def test_right_in_the_picture_is_right_of_the_robot_and_its_top_is_the_front() -> None:
    right, top = ShellView(camera=CAMERA).back_project(CENTRE + np.array([[5.0, 0.0], [0.0, -5.0]]))
    assert right[1] == pytest.approx(-5 * HEIGHT / F, rel=1e-3)
    assert top[0] == pytest.approx(5 * HEIGHT / F, rel=1e-3)
    assert (right[0], top[1]) == (0.0, 0.0)


@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["pinhole", "distorted"])
def test_there_and_back(camera: PinholeCamera) -> None:
    view = ShellView(camera=camera, parameters=ShellViewParameters(camera_tilt=[0.02, -0.03, 0.05]))
    points = view.back_project(pixels())
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), RADIUS, rtol=1e-12)
    np.testing.assert_allclose(project(camera, view.X_SC, points), pixels(), atol=1e-6)
    # Of the two points of the shell on a ray it is the near one.
    line = points - view.X_SC.translation()
    assert (np.sum(line * points, axis=1) < 0).all()


def test_a_ray_past_the_shell_has_no_point_and_the_far_side_no_pixel() -> None:
    X_SC = ShellView(camera=CAMERA).X_SC
    # sin(horizon) = 75/85: a ray at 61.9 degrees touches it.
    tangent = F * np.tan(np.arcsin(75 / 85))
    seen = back_project(
        CAMERA, X_SC, RADIUS, CENTRE + np.array([[0.999 * tangent, 0], [1.001 * tangent, 0]])
    )
    assert np.isfinite(seen).all(axis=1).tolist() == [True, False]
    away = X_SC @ RigidTransform(RotationMatrix.MakeXRotation(np.pi), np.zeros(3))
    assert np.isnan(back_project(CAMERA, away, RADIUS, CENTRE[None])).all()
    # It sees as far down as cos(a) = 75/85.
    edge = np.arccos(75 / 85)
    for angle, visible in ((0.99 * edge, True), (1.01 * edge, False), (np.pi, False)):
        point = RADIUS * np.array([[np.sin(angle), 0.0, np.cos(angle)]])
        assert np.isfinite(project(CAMERA, X_SC, point)).all() == visible


def test_a_robot_that_drives_on_sees_the_ground_go_back_and_turn_against_it() -> None:
    view = ShellView(camera=CAMERA)
    w = 1e-4
    forward = view.turned(CENTRE[None], np.array([0.0, w, 0.0]))[0] - CENTRE
    left = view.turned(CENTRE[None], np.array([-w, 0.0, 0.0]))[0] - CENTRE
    np.testing.assert_allclose(forward, [0, F * RADIUS * w / HEIGHT], atol=1e-4)
    np.testing.assert_allclose(left, [F * RADIUS * w / HEIGHT, 0], atol=1e-4)
    # Turning left by w, what was in front is now to the right of the front.
    top = CENTRE + np.array([[0.0, -100.0]])
    moved = view.turned(top, np.array([0.0, 0.0, w]))[0] - top[0]
    np.testing.assert_allclose(moved, [100 * w, 0], atol=1e-5)


def test_a_tilted_camera_looks_beside_the_point_below() -> None:
    # Tilted about the left axis by a, the optical axis swings from -z toward -x.
    a = 0.01
    view = ShellView(camera=CAMERA, parameters=ShellViewParameters(camera_tilt=[0, a, 0]))
    point = view.back_project(CENTRE[None])[0]
    assert point[0] == pytest.approx(-HEIGHT * a, rel=1e-3)


def test_the_picture_ends_half_a_pixel_beyond_the_centres_of_its_last_pixels() -> None:
    edge = np.array(
        [[-0.5, -0.5], [639.5, 479.5], [-0.51, 0], [0, 479.51], [np.nan, 0], [1e300, 0]]
    )
    assert inside(CAMERA, edge).tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"radius": 0.0}, "radius is 0.0: must be greater than 0"),
        ({"camera_height": -0.001}, "camera_height is -0.001: must be greater than 0"),
        ({"camera_height": np.nan}, "camera_height is nan"),
        ({"camera_tilt": [0.0, 0.0]}, "camera_tilt is [0.0, 0.0]: must be three finite numbers"),
    ],
)
def test_a_camera_in_the_shell_is_refused(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        ShellViewParameters(**bad)
