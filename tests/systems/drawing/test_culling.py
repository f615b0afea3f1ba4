"""What is left out must not be in the picture, and what is far beside it must be left out."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import FrameId

from systems.cameras import PinholeCamera
from systems.drawing.culling import BoundingBalls, pyramid

K = np.array([[500.0, 0.0, 319.5], [0.0, 480.0, 239.5], [0.0, 0.0, 1.0]])
CAMERAS = [
    PinholeCamera(640, 480, K, np.zeros(5)),
    PinholeCamera(640, 480, K, np.array([-0.2, 0.05, 0.001, -0.001, 0.0])),
]
STILL = np.hstack([np.eye(3), np.zeros((3, 1))])


@pytest.mark.parametrize("camera", CAMERAS)
def test_nothing_with_a_point_in_the_picture_is_left_out(camera: PinholeCamera) -> None:
    random = np.random.default_rng(0)
    middles = random.uniform([-4, -4, -4], [4, 4, 4], (400, 3))
    things = [m + random.uniform(-0.4, 0.4, (6, 3)) for m in middles]
    balls = BoundingBalls([FrameId.get_new_id()] * len(things), things)
    seen = balls.in_view(camera, dict.fromkeys(balls.frames, STILL))
    kept = set(seen)
    assert seen == sorted(kept)
    shown = 0
    for k, points in enumerate(things):
        ahead = points[points[:, 2] > 0.05]
        ahead = ahead[np.hypot(*(ahead[:, :2] / ahead[:, 2:]).T) < camera.fold_radius]
        pixels = camera.project(ahead)
        inside = ((pixels >= -0.5) & (pixels < [639.5, 479.5])).all(axis=1).any()
        shown += inside
        assert not inside or k in kept
    assert shown > 20
    assert len(kept) < 0.5 * len(things)  # it is worth its while


def test_each_frame_has_its_own_pose() -> None:
    a, b = FrameId.get_new_id(), FrameId.get_new_id()
    point = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    balls = BoundingBalls([a, b, a], [point, point, point + np.array([0.0, 0.0, 5.0])])
    ahead, behind = STILL.copy(), STILL.copy()
    ahead[2, 3], behind[2, 3] = 2.0, -2.0
    assert balls.in_view(CAMERAS[0], {a: ahead, b: behind}) == [0, 2]
    assert balls.in_view(CAMERAS[0], {a: behind, b: ahead}) == [1, 2]


def test_the_pyramid_holds_the_picture_and_little_more() -> None:
    normals = pyramid(CAMERAS[0])
    u, v = np.meshgrid([0.0, 639.0], [0.0, 479.0])
    rays = np.stack([(u - 319.5) / 500, (v - 239.5) / 480, np.ones((2, 2))], axis=-1)
    assert (rays.reshape(-1, 3) @ normals.T > 0).all()
    outside = np.array([(643 - 319.5) / 500, 0.0, 1.0])
    assert (normals @ outside).min() < 0


def test_none_is_none() -> None:
    assert BoundingBalls([], []).in_view(CAMERAS[0], {}) == []
