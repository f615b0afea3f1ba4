"""Where a robot stands on a sphere and which way it heads: rotation, roll, pitch and yaw.

Frame R of the sphere has its origin in the centre, z toward the pole and x toward yaw 0 on the
equator. Frame B of the robot on it has x forward, y left and z along the outward normal. Yaw is the
longitude of the place it stands on, pitch the latitude, roll the heading about the outward normal,
counter-clockwise as seen from outside; at roll 0 it heads to the pole:

    R_RB = Rz(yaw) Ry(-pitch) Rx(roll) R_0,   R_0 = [z_R, -y_R, x_R]

At the poles yaw and roll are not separate: their sum is all there is at pitch 90, their difference
at pitch -90. So errors are rotation vectors in R, and differences of angles are given beside them
where they mean something (`angles_defined`).

Every function takes arrays with any leading axes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.compiled import packed
from systems.small_matrices import rotation_of, rotation_vector_of

Array = NDArray[np.float64]

SHELL_FRAME = "shell"  # the name that frame R has in messages and marker maps

# Axes of B in R at roll = pitch = yaw = 0.
_R_0 = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
# Nearer to a pole than this (cosine of the pitch), rounding decides what yaw is.
_AT_POLE = 1e-9


def upright(pitch: Array | float, yaw: Array | float) -> Array:
    """Returns Rz(yaw) Ry(-pitch): the frame of what stands upright at a place of the sphere.

    Its x is the outward normal, y points to the east (rising yaw), z to the pole.

    Args:
        pitch: (...) rad.
        yaw: (...) rad.

    Returns:
        (..., 3, 3).
    """
    pitch, yaw = np.broadcast_arrays(np.asarray(pitch, float), np.asarray(yaw, float))
    cp, sp, cy, sy = np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    zero = np.zeros_like(cp)
    rows = [[cp * cy, -sy, -sp * cy], [cp * sy, cy, -sp * sy], [sp, zero, cp]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation(angles: Array) -> Array:
    """Returns `R_RB` (..., 3, 3) of [roll, pitch, yaw] (..., 3) rad."""
    angles = np.asarray(angles, float)
    roll, pitch, yaw = (angles[..., k] for k in range(3))
    c, s = np.cos(roll), np.sin(roll)
    one, zero = np.ones_like(c), np.zeros_like(c)
    rows = [[one, zero, zero], [zero, c, -s], [zero, s, c]]
    about_normal = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return np.asarray(upright(pitch, yaw) @ about_normal @ _R_0)


def angles_of(R_RB: Array) -> Array:
    """Returns [roll, pitch, yaw] (..., 3) rad of `R_RB` (..., 3, 3).

    Roll and yaw lie in (-pi, pi], pitch in [-pi/2, pi/2]. At a pole, where only the sum of yaw and
    roll (their difference at pitch -90) is defined, roll is 0 by convention.
    """
    R = np.asarray(R_RB, float) @ _R_0.T
    cosine = np.hypot(R[..., 0, 0], R[..., 1, 0])
    pole = cosine < _AT_POLE
    roll = np.where(pole, 0.0, np.arctan2(R[..., 2, 1], R[..., 2, 2]))
    pitch = np.arctan2(R[..., 2, 0], cosine)
    yaw = np.where(
        pole, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), np.arctan2(R[..., 1, 0], R[..., 0, 0])
    )
    return np.stack([wrap(roll), pitch, wrap(yaw)], axis=-1)


def angles_defined(R_RB: Array, margin: float = math.radians(10.0)) -> NDArray[np.bool_]:
    """Returns (...) where yaw and roll are separate: farther than `margin` (rad) from both poles.

    An error of direction of e is one of yaw (and of roll) of e / cos(pitch): 5.8 e at 10 degrees
    from the pole.
    """
    return np.asarray(np.hypot(R_RB[..., 0, 2], R_RB[..., 1, 2]) > math.sin(margin))


def rotation_vector(R: Array) -> Array:
    """Returns the rotation vectors (..., 3) rad, of length 0 to pi, of rotations (..., 3, 3).

    Through the quaternion's outer product with itself, whose largest row is well conditioned at
    every angle, half a turn included.
    """
    R = np.asarray(R, float)
    if R.ndim == 2:
        w = np.empty(3)
        rotation_vector_of(packed(R), w)
        return w
    a, b, c = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    wx, wy, wz = (
        R[..., 2, 1] - R[..., 1, 2],
        R[..., 0, 2] - R[..., 2, 0],
        R[..., 1, 0] - R[..., 0, 1],
    )
    xy, xz, yz = (
        R[..., 0, 1] + R[..., 1, 0],
        R[..., 0, 2] + R[..., 2, 0],
        R[..., 1, 2] + R[..., 2, 1],
    )
    rows = [
        [1 + a + b + c, wx, wy, wz],
        [wx, 1 + a - b - c, xy, xz],
        [wy, xy, 1 - a + b - c, yz],
        [wz, xz, yz, 1 - a - b + c],
    ]
    product = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)  # 4 q q'
    largest = np.argmax(np.diagonal(product, axis1=-2, axis2=-1), axis=-1)[..., None, None]
    q = np.take_along_axis(product, largest, axis=-2)[..., 0, :]
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    cosine = q[..., :1]
    # angle / |v| tends to 2 / w.
    scale = np.where(sine > 0, 2 * np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1.0), 0.0)
    return np.asarray(scale * q[..., 1:])


def one_rotation(w: Array) -> Array:
    """Returns exp([w]x) (3, 3) of a single rotation vector (3,) rad (Rodrigues).

    `systems.markers.pnp.rotation_from_vector` is for many.
    """
    R = np.empty((3, 3))
    rotation_of(packed(w), R)
    return R


def rotation_error(R_estimate: Array, R_true: Array) -> Array:
    """Returns phi (..., 3) rad in R with R_estimate = exp([phi]x) R_true: the estimate's error."""
    return rotation_vector(R_estimate @ np.swapaxes(R_true, -1, -2))


def angle_differences(R_estimate: Array, R_true: Array) -> Array:
    """Returns the differences of [roll, pitch, yaw] (..., 3) rad, roll and yaw wrapped.

    What the paper reports; meaningless near the poles (`angles_defined`).
    """
    return np.asarray(wrap(angles_of(R_estimate) - angles_of(R_true)))


def nearest_rotation(R: Array) -> Array:
    """Returns the rotation (..., 3, 3) next to a product of rotations, which rounding has bent."""
    return np.asarray(1.5 * R - 0.5 * R @ (R.swapaxes(-1, -2) @ R))  # a Newton step
