"""Planar angles and poses: wrapping, composition."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix


def wrap(angle: Any) -> Any:
    """Returns the angle (rad) in (-pi, pi]; a float, or an array of floats."""
    if isinstance(angle, np.ndarray):
        return np.pi - np.remainder(np.pi - angle, 2 * np.pi)
    return math.pi - (math.pi - angle) % (2 * math.pi)


def planar_pose(X_WB: RigidTransform) -> np.ndarray:
    """Returns [x, y, theta] of a pose: its position on the ground and its heading (yaw)."""
    R = X_WB.rotation().matrix()
    p = X_WB.translation()
    return np.array([p[0], p[1], np.arctan2(R[1, 0], R[0, 0])])


def spatial_pose(pose: np.ndarray, z: float = 0.0) -> RigidTransform:
    """Returns the `RigidTransform` of a planar pose [x, y, theta] at height z (m)."""
    R = RotationMatrix.MakeZRotation(float(pose[2]))
    return RigidTransform(R, np.array([pose[0], pose[1], z]))
