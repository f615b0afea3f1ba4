"""What wheels say of the camera's motion between frames: smoothness where few tags are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.mapping.scene import Motion
from systems.markers.pnp import cross_matrix
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class OdometryParameters:
    """How far planar odometry is trusted; standard deviations between two frames.

    Attributes:
        slip: of the distance, along and across, as a part of it.
        turn: of the heading, as a part of the turn.
        position_floor: of the position, whatever the distance, m.
        heading_floor: of the heading, whatever the turn, rad.
        height: of the body's height, m: floors are not quite flat.
        tilt: of roll and pitch, rad.
        longest: frames farther apart in time than this are not connected, s.
    """

    slip: float = 0.1
    turn: float = 0.1
    position_floor: float = 0.002
    heading_floor: float = 0.01
    height: float = 0.005
    tilt: float = 0.01
    longest: float = 1.0

    def __post_init__(self) -> None:
        require_non_negative(slip=self.slip, turn=self.turn)
        require_positive(
            position_floor=self.position_floor,
            heading_floor=self.heading_floor,
            height=self.height,
            tilt=self.tilt,
            longest=self.longest,
        )


def motion_of_odometry(
    frames: Array,
    stamps: Array,
    poses: Array,
    *,
    X_BC: RigidTransform,
    parameters: OdometryParameters | None = None,
) -> Motion:
    """Returns the camera's motion from frame to frame as planar odometry of its body has it.

    Args:
        frames: (n,) times of the frames, ascending, s.
        stamps: (m,) times of the odometry, s, strictly ascending.
        poses: (m, 3) [x (m), y (m), theta (rad)] of the body B in a frame of its own.
        X_BC: pose of the camera's optical frame C in B.
        parameters: how far it is trusted.

    Returns:
        n - 1 motions; without information where odometry does not reach.

    Raises:
        ValueError: stamps that do not ascend, or no two of them.
    """
    p = parameters or OdometryParameters()
    require(len(stamps) >= 2, "odometry", len(stamps), "two samples or more")
    require(bool((np.diff(stamps) > 0).all()), "odometry", "unordered", "ascending in time")
    unwrapped = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])
    x, y, theta = (np.interp(frames, stamps, column) for column in unwrapped.T)
    cos, sin = np.cos(theta[:-1]), np.sin(theta[:-1])
    dx, dy = np.diff(x), np.diff(y)
    turn = np.diff(theta)
    p_B = np.stack([cos * dx + sin * dy, cos * dy - sin * dx, 0 * dx], axis=1)
    R_B = np.zeros((len(turn), 3, 3))
    R_B[:, 0, 0] = R_B[:, 1, 1] = np.cos(turn)
    R_B[:, 1, 0] = np.sin(turn)
    R_B[:, 0, 1] = -R_B[:, 1, 0]
    R_B[:, 2, 2] = 1
    R_BC, p_BC = X_BC.rotation().matrix(), X_BC.translation()
    arm = R_B @ p_BC
    place = p.slip * np.hypot(dx, dy) + p.position_floor
    flat = np.ones(len(turn))
    deviation = np.stack(
        [p.tilt * flat, p.tilt * flat, p.turn * np.abs(turn) + p.heading_floor,
         place, place, p.height * flat], axis=1
    )  # fmt: skip
    # From errors told in B to those of C' in C: a turn of B swings the camera.
    J = np.zeros((len(turn), 6, 6))
    J[:, :3, :3] = J[:, 3:, 3:] = R_BC.T
    J[:, 3:, :3] = R_BC.T @ cross_matrix(-arm)
    root = np.linalg.inv(J * deviation[:, None])
    inside = (frames >= stamps[0]) & (frames <= stamps[-1])
    gap = np.diff(stamps)[np.clip(np.searchsorted(stamps, frames) - 1, 0, len(stamps) - 2)]
    sound = inside & (gap <= p.longest)
    known = sound[:-1] & sound[1:] & (np.diff(frames) <= p.longest)
    root[~known] = 0.0
    return Motion(R_BC.T @ R_B @ R_BC, (p_B + arm - p_BC) @ R_BC, root)
