"""Where a robot is by the bearings of three beacons that stand at known places.

All in the plane: a picture gives each beacon's lateral pixel u, counted from the principal point,
positive to the picture's right. A point [x, y] in the axes of the robot (x forward, y left) shows
at u = -f y / x, in the camera that looks forward (x > 0) and in the one that looks backward (x < 0)
alike: the right of the picture behind is the robot's left. Leading dimensions are batches.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.validation import require_non_negative, require_positive

Array = NDArray[np.float64]

_ITERATIONS = 15
_CONVERGED = 1e-9  # last step, m and rad
_FARTHEST_STEP = 0.5  # m and rad


class Resection(NamedTuple):
    """A pose from bearings.

    Attributes:
        pose: (..., 3) [x (m), y (m), theta (rad)]; NaN where there is none: fewer than three
            beacons seen, all on one circle with the robot, or one on the wrong side of it.
        covariance: (..., 3, 3) of the pose; NaN likewise.
    """

    pose: Array
    covariance: Array


def bearing(u: Any, focal_length: float, *, backward: bool = False) -> Any:
    """Returns the direction (rad, to the left of ahead) of what shows at lateral pixel u."""
    angle = -np.arctan(np.asarray(u, float) / focal_length)
    return wrap(angle + np.pi) if backward else angle


def in_robot(pose: Array, points: Array) -> Array:
    """Returns points (..., n, 2) of the world in the axes of robots at pose (..., 3)."""
    offset = points - pose[..., None, :2]
    c, s = np.cos(pose[..., 2:]), np.sin(pose[..., 2:])
    x, y = offset[..., 0], offset[..., 1]
    return np.stack([c * x + s * y, c * y - s * x], axis=-1)


def lateral_pixels(pose: Array, points: Array, focal_length: float) -> tuple[Array, Array]:
    """Projects points of the world, and differentiates by the pose.

    Args:
        pose: (..., 3) of the robot.
        points: (..., n, 2) m; whichever camera faces them is meant.
        focal_length: px.

    Returns:
        u (..., n) px, and its derivatives (..., n, 3), px/m and px/rad.
    """
    p_B = in_robot(pose, points)
    x, y = p_B[..., 0], p_B[..., 1]
    by_x, by_y = focal_length * y / x**2, -focal_length / x
    c, s = np.cos(pose[..., 2:]), np.sin(pose[..., 2:])
    jacobian = np.stack([s * by_y - c * by_x, -s * by_x - c * by_y, y * by_x - x * by_y], axis=-1)
    return -focal_length * y / x, jacobian


def pixel_covariance(count: int, pixel_std: float, centre_std: float, frames: int = 1) -> Array:
    """Returns the covariance (count, count) of pixels averaged over pictures, px^2.

    Noise is averaged away; the error of the principal point is the same in all and stays. (So does
    that of the camera's yaw, but it turns the estimated heading alone, and the robot steers by what
    the camera sees.)

    Args:
        count: number of pixels.
        pixel_std: noise of one in one picture, px.
        centre_std: standard deviation of the principal point, px.
        frames: number of pictures.
    """
    require_positive(pixel_std=pixel_std, frames=frames)
    require_non_negative(centre_std=centre_std)
    common = np.full((count, count), centre_std**2)
    return common + np.eye(count) * pixel_std**2 / frames


def cramer_rao(pose: Array, points: Array, focal_length: float, covariance: Array) -> Array:
    """Returns the least covariance (..., 3, 3) that an unbiased estimate of the pose can have.

    Args:
        pose: (..., 3) the true one.
        points: (..., n, 2) the beacons, m.
        focal_length: px.
        covariance: (n, n) of the pixels (see `pixel_covariance`), px^2.
    """
    jacobian = lateral_pixels(pose, points, focal_length)[1]
    information = np.swapaxes(jacobian, -1, -2) @ np.linalg.inv(covariance) @ jacobian
    return np.asarray(np.linalg.inv(information), float)


def resect(
    u: Array, points: Array, focal_length: float, covariance: Array, guess: Array
) -> Resection:
    """Finds the pose by least squares (Gauss-Newton, weighted by the pixels' covariance).

    Args:
        u: (..., n) px, n >= 3, of one picture or averaged over several.
        points: (..., n, 2) the beacons, m.
        focal_length: px.
        covariance: (n, n) of the pixels, px^2.
        guess: (..., 3) where to start: any pose from which the beacons would be seen by the same
            camera.
    """
    weights = np.linalg.inv(covariance)
    shape = np.broadcast_shapes(u.shape[:-1], points.shape[:-2], guess.shape[:-1])
    pose = np.array(np.broadcast_to(guess, (*shape, 3)))
    step = np.zeros_like(pose)
    normal = np.zeros((*shape, 3, 3))
    backward = in_robot(pose, points)[..., 0] < 0
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS if u.shape[-1] >= 3 else 0):
            predicted, jacobian = lateral_pixels(pose, points, focal_length)
            by_pose = np.swapaxes(jacobian, -1, -2) @ weights
            normal = by_pose @ jacobian
            step = _solved(normal, (by_pose @ (u - predicted)[..., None])[..., 0])
            pose = pose + np.clip(step, -_FARTHEST_STEP, _FARTHEST_STEP)
        found = (np.abs(step) < _CONVERGED).all(axis=-1) & np.isfinite(pose).all(axis=-1)
        found &= ((in_robot(pose, points)[..., 0] < 0) == backward).all(axis=-1)
        found &= np.linalg.cond(np.where(found[..., None, None], normal, np.eye(3))) < 1e12
        found &= u.shape[-1] >= 3
        result = np.where(found[..., None, None], normal, np.full((3, 3), np.nan))
        pose[..., 2] = wrap(pose[..., 2])
    return Resection(np.where(found[..., None], pose, np.nan), _inverted(result))


def _solved(matrix: Array, vector: Array) -> Array:
    """Solves batches of 3 x 3 systems; a singular one gives what is not finite."""
    return (_inverted(matrix) @ vector[..., None])[..., 0]


def _inverted(matrix: Array) -> Array:
    """Inverts batches of symmetric 3 x 3 matrices by their adjugates: NaN where singular."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    adjugate = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    with np.errstate(all="ignore"):
        inverse: Array = adjugate / (a * adjugate[..., :, 0]).sum(axis=-1)[..., None, None]
    return inverse
