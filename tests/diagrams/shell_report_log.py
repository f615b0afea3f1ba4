"""Logs of a drive over a shell whose errors are chosen by hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from diagrams.shell_metrics import ShellLog
from systems.shell.angles import rotation

RADIUS = 0.075
HEIGHT = 0.004  # of the robot's frame


def drive(n: int) -> np.ndarray:
    """R_RB (n, 3, 3): over the pole to yaw 180, a turn by -90 degrees, half of the equator."""
    over = np.linspace(0, 180, n - n // 10 - n // 2)
    turn = np.linspace(180, 90, n // 10)
    along = np.linspace(180, 0, n // 2)
    far = over > 90
    angles = np.concatenate(
        [
            np.stack([180.0 * far, np.minimum(over, 180 - over), 180.0 * far], axis=1),
            np.stack([turn, 0 * turn, 180 + 0 * turn], axis=1),
            np.stack([90 + 0 * along, 0 * along, along], axis=1),
        ]
    )
    return rotation(np.radians(angles))


def shell_log(
    errors: ArrayLike,
    *,
    markers_met: np.ndarray | None = None,
    covariance: np.ndarray | None = None,
    iterations: int = 1,
) -> ShellLog:
    """A log of n samples whose errors (n, 3) deg are rotation vectors in R."""
    phi = np.radians(np.asarray(errors, float).reshape(-1, 3))
    n = len(phi)
    R = np.concatenate(
        [np.zeros((0, 3, 3)), *(drive(n // iterations) for _ in range(iterations) if n)]
    )
    R_estimate = Rotation.from_rotvec(phi).as_matrix() @ R if n else R
    return ShellLog(
        t=np.arange(n) / 50,
        R=R,
        p=(RADIUS + HEIGHT) * R[:, :, 2],
        R_estimate=R_estimate,
        p_estimate=(RADIUS + HEIGHT) * R_estimate[:, :, 2],
        covariance=np.tile(np.eye(6) * 1e-4, (n, 1, 1)) if covariance is None else covariance,
        iteration=np.arange(n) // max(n // iterations, 1),
        visible=np.arange(n) % 5 == 0,
        markers_met=np.full(n, 2) if markers_met is None else markers_met,
    )
