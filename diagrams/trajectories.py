"""Trajectories as TUM files, which any trajectory tool reads: `t x y z qx qy qz qw` a line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_UNIT = 1e-3


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


def read_tum(path: Path) -> tuple[Array, Array]:
    """Reads a TUM file; lines that begin with # are comments.

    Returns:
        t: (n,) s, ascending.
        poses: (n, 7) quaternion w, x, y, z of unit length, then x, y, z (m).

    Raises:
        ValueError: the file is missing, empty, or a line is no pose or goes back in time.
    """
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise ValueError(f"trajectory {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"trajectory {path} is not text: {error}") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"trajectory {path}, line {number}"
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != 8:
            raise ValueError(f"{where} is {line[:60]!r}: must be t x y z qx qy qz qw")
        if not all(map(math.isfinite, row)):
            raise ValueError(f"{where} is not finite: {line[:60]!r}")
        length = math.hypot(*row[4:])
        if abs(length - 1) > _UNIT:
            raise ValueError(f"{where}: the quaternion is of length {length:.4g}, must be 1")
        if rows and row[0] <= rows[-1][0]:
            raise ValueError(f"{where}: t is {row[0]}, must be after {rows[-1][0]}")
        x, y, z, w = (value / length for value in row[4:])
        rows.append([row[0], w, x, y, z, *row[1:4]])
    if not rows:
        raise ValueError(f"trajectory {path} is empty")
    table = np.array(rows)
    return table[:, 0], table[:, 1:]
