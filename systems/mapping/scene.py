"""Where cameras and tags are, and how far that is from what pictures and odometry say.

Tangents: rotation first, a small rotation vector in the parent (C for cameras, W for tags), then
the position in the parent.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.mapping.sightings import Sightings
from systems.markers.layout import marker_corners
from systems.markers.pnp import cross_matrix, rotation_from_vector

Array = NDArray[np.float64]

_CORNERS = marker_corners(1.0)
_MIN_DEPTH = 1e-3  # m before the camera


@dataclass(frozen=True, eq=False)
class Scene:
    """Where cameras and tags are.

    Attributes:
        R_CW: (frames, 3, 3).
        p_CW: (frames, 3) m.
        R_WT: (tags, 3, 3).
        p_WT: (tags, 3) m.
    """

    R_CW: Array
    p_CW: Array
    R_WT: Array
    p_WT: Array

    def positions(self) -> Array:
        """Returns `p_WC` of the cameras, (frames, 3) m."""
        return -(self.R_CW.swapaxes(1, 2) @ self.p_CW[..., None])[..., 0]

    def moved(self, cameras: Array, tags: Array) -> Scene:
        """Returns it after steps (frames, 6) and (tags, 6)."""
        R_CW, p_CW = _screwed(self.R_CW, self.p_CW, cameras)
        R_WT, p_WT = _screwed(self.R_WT, self.p_WT, tags)
        return Scene(R_CW, p_CW, R_WT, p_WT)


def _screwed(R: Array, p: Array, steps: Array) -> tuple[Array, Array]:
    """Returns poses after steps (n, 6), along screws.

    To first order that is a turn and a shift. But what turns together, cameras and tags about a far
    anchor, does so on circles: on straight lines the adjustment would creep along every bend.
    """
    turn, shift = steps[:, :3], steps[:, 3:]
    v = (shift - np.cross(turn, p))[..., None]
    squared = (turn * turn).sum(axis=1)
    angle = np.sqrt(squared)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - squared / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - squared / 120, (safe - np.sin(safe)) / safe**3)
    K = cross_matrix(turn)
    turned = rotation_from_vector(turn)
    along = v + a[:, None, None] * (K @ v) + b[:, None, None] * (K @ (K @ v))
    return turned @ R, (turned @ p[..., None] + along)[..., 0]


@dataclass(frozen=True, eq=False)
class Motion:
    """What odometry says of the way from each frame to the next: (frames - 1) of each.

    Attributes:
        R: (n, 3, 3) `R_CC'`, of the next camera C' in this one C.
        p: (n, 3) `p_CC'`, m.
        root: (n, 6, 6) square root of the information: root @ error has unit covariance; zeros
            where nothing is known. The error is [rotation vector, position] in C.
    """

    R: Array
    p: Array
    root: Array

    def over(self, frames: NDArray[np.intp]) -> Motion:
        """Returns it between the chosen frames (ascending) only, one motion after the other."""
        R, p, root = [], [], []
        for first, last in itertools.pairwise(frames.tolist()):
            R_k, p_k, C = np.eye(3), np.zeros(3), np.zeros((6, 6))
            known = all(self.root[k].any() for k in range(first, last))
            for k in range(first, last):
                turned = np.zeros((6, 6))
                turned[:3, :3] = turned[3:, 3:] = R_k
                arm = cross_matrix(R_k @ self.p[k])
                information = self.root[k].T @ self.root[k]
                # Earlier errors of rotation swing what comes later.
                carry = np.eye(6)
                carry[3:, :3] = -arm
                C = carry @ C @ carry.T + turned @ np.linalg.pinv(information) @ turned.T
                R_k, p_k = R_k @ self.R[k], p_k + R_k @ self.p[k]
            R.append(R_k)
            p.append(p_k)
            root.append(np.linalg.cholesky(np.linalg.inv(C)).T if known else np.zeros((6, 6)))
        return Motion(np.array(R), np.array(p), np.array(root))


def residuals(scene: Scene, sightings: Sightings) -> tuple[Array, Array, Array]:
    """Returns the residuals of corners and their derivatives.

    Returns:
        (m, 8) px, and (m, 8, 6) by the camera's step and by the tag's. Of a corner that is not
        before the camera the residuals are infinite.
    """
    s = sightings
    arm_W, arm_C, p_C, behind = _corners(scene, s)
    ray = p_C[..., :2] / p_C[..., 2:]
    by_position = np.empty((len(s), 4, 2, 3))
    by_position[..., :2] = s.by_ray
    by_position[..., 2] = -_pixels(s.by_ray, ray)
    by_position /= p_C[..., 2][..., None, None]
    by_camera = np.empty((len(s), 4, 2, 6))
    by_camera[..., :3] = _cross(arm_C, by_position)
    by_camera[..., 3:] = by_position
    by_tag = np.empty((len(s), 4, 2, 6))
    # One product of 8 x 3 is faster than eight of 1 x 3.
    moved = by_position.reshape(-1, 8, 3) @ scene.R_CW[s.frame]
    by_tag[..., 3:] = moved.reshape(by_position.shape)
    by_tag[..., :3] = _cross(arm_W, by_tag[..., 3:])
    r = _pixels(s.by_ray, ray - s.rays).reshape(-1, 8)
    r[behind] = np.inf
    return r, by_camera.reshape(-1, 8, 6), by_tag.reshape(-1, 8, 6)


def corner_errors(scene: Scene, sightings: Sightings) -> Array:
    """Returns the residuals (m, 8) alone, px (see `residuals`)."""
    _, _, p_C, behind = _corners(scene, sightings)
    ray = p_C[..., :2] / p_C[..., 2:]
    r = _pixels(sightings.by_ray, ray - sightings.rays).reshape(-1, 8)
    r[behind] = np.inf
    return r


def _corners(scene: Scene, s: Sightings) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Returns where the corners are: four arrays over the sightings.

    Returns:
        (m, 4, 3) from the tag's centre, told in W; from W's origin, told in C; in C; and (m,)
        whether one of them is not before the camera: those are put on its axis.
    """
    R_CW, p_CW = scene.R_CW[s.frame], scene.p_CW[s.frame]
    arm_W = (_CORNERS * s.sizes[s.tag][:, None, None]) @ scene.R_WT[s.tag].swapaxes(1, 2)
    arm_C = (arm_W + scene.p_WT[s.tag][:, None]) @ R_CW.swapaxes(1, 2)
    p_C = arm_C + p_CW[:, None]
    behind = np.asarray((p_C[..., 2] < _MIN_DEPTH).any(axis=1))
    p_C[behind] = (0.0, 0.0, 1.0)
    return arm_W, arm_C, p_C, behind


def _pixels(by_ray: Array, ray: Array) -> Array:
    """Returns by_ray @ ray, of (..., 2, 2) and (..., 2)."""
    return by_ray[..., 0] * ray[..., :1] + by_ray[..., 1] * ray[..., 1:]


def _cross(arm: Array, rows: Array) -> Array:
    """Returns arm x row, of (m, 4, 3) and of each row of (m, 4, 2, 3)."""
    a, b, c = arm[:, :, None, 0], arm[:, :, None, 1], arm[:, :, None, 2]
    x, y, z = rows[..., 0], rows[..., 1], rows[..., 2]
    crossed = np.empty(rows.shape)
    crossed[..., 0], crossed[..., 1], crossed[..., 2] = b * z - c * y, c * x - a * z, a * y - b * x
    return crossed


def motion_residuals(scene: Scene, motion: Motion) -> tuple[Array, Array, Array]:
    """Returns the residuals of motions and their derivatives.

    Returns:
        (n, 6), and (n, 6, 6) by the steps of a camera and of the next one.
    """
    R, p = scene.R_CW, scene.p_CW
    R_rel = R[:-1] @ R[1:].swapaxes(1, 2)
    p_next = (R_rel @ p[1:, :, None])[..., 0]
    turn = rotation_vector(R_rel @ motion.R.swapaxes(1, 2))
    error = np.concatenate([turn, p[:-1] - p_next - motion.p], axis=1)
    n = len(R) - 1
    here, there = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    # The rotation vector's own derivative is 1 to first order in the error, which is small.
    here[:, :3, :3] = here[:, 3:, 3:] = np.eye(3)
    here[:, 3:, :3] = cross_matrix(p_next)
    there[:, :3, :3] = there[:, 3:, 3:] = -R_rel
    there[:, 3:, :3] = -R_rel @ cross_matrix(p[1:])
    return (motion.root @ error[..., None])[..., 0], motion.root @ here, motion.root @ there


def rotation_vector(R: Array) -> Array:
    """Returns the rotation vectors (n, 3) of rotations (n, 3, 3) by less than half a turn, rad."""
    twice_sine = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]]
    )
    sine = np.sqrt((twice_sine**2).sum(axis=0)) / 2
    angle = np.arctan2(sine, (np.trace(R, axis1=1, axis2=2) - 1) / 2)
    return (twice_sine * np.where(sine > 1e-9, angle / np.maximum(2 * sine, 1e-300), 0.5)).T
