"""Trajectories as TUM files, which any trajectory tool reads: `t x y z qx qy qz qw` a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def write_tum(path: Path, t: Array, poses: Array) -> None:
    """Writes planar poses.

    Args:
        path: of the file.
        t: (n,) s.
        poses: (n, 3) [x (m), y (m), theta (rad)].
    """
    half = poses[:, 2] / 2
    zero = np.zeros(len(t))
    rows = np.column_stack([t, poses[:, :2], zero, zero, zero, np.sin(half), np.cos(half)])
    np.savetxt(path, rows, fmt="%.9f")


def write_poses(path: Path, t: Array, poses: Array) -> None:
    """Writes poses in space.

    Args:
        path: of the file.
        t: (n,) s.
        poses: (n, 7) quaternion w, x, y, z, then x, y, z (m), as `PoseToVector` gives them.
    """
    rows = np.column_stack([t, poses[:, 4:7], poses[:, 1:4], poses[:, 0]])
    np.savetxt(path, rows, fmt="%.9f")
