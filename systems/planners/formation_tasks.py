"""What a formation's mover is told, and which robots are known well enough to tell it of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.controllers.step_task import StepTask
from systems.planners.formation_course import FormationMove

Array = NDArray[np.float64]


def task_of(move: FormationMove, poses: Array, standing: NDArray[np.bool_]) -> StepTask:
    """Returns the task of a move.

    Args:
        move: of the planner.
        poses: (N, 3) of all robots, as they are believed to be.
        standing: (N,) which of them stand there; of the mover and its beacons it does not matter.
    """
    others = standing.copy()
    others[[move.mover, *move.beacons]] = False
    return StepTask(
        number=move.number,
        beacons=move.beacons,
        poses=poses[move.beacons],
        target=move.target,
        start=poses[move.mover, :2].copy(),
        points=move.points[:-1].copy(),
        others=np.flatnonzero(others),
        other_poses=poses[others],
    )


def way_length(task: StepTask) -> float:
    """Returns how far it is by a task's way, m; 0 when its start is not known."""
    way = np.vstack([task.start, task.points, task.target])
    return float(np.nan_to_num(np.hypot(*np.diff(way, axis=0).T).sum()))


def not_found(covariance: Array, std: float) -> NDArray[np.bool_]:
    """Returns which robots are known well from no other, (N,).

    What matters is where they are from each other: from the start all get to be known less and
    less.

    Args:
        covariance: (3 N, 3 N) of their poses [x, y, theta].
        std: of the place against another's, along the worst axis, m.
    """
    n = len(covariance) // 3
    P = covariance.reshape(n, 3, n, 3)[:, :2, :, :2]
    own, cross = np.einsum("iaib->iab", P), P.transpose(0, 2, 1, 3)
    apart = own[:, None] + own[None] - cross - cross.transpose(0, 1, 3, 2)
    worst = np.linalg.eigvalsh(np.nan_to_num(apart, nan=1e9))[..., -1]
    worst[np.arange(n), np.arange(n)] = np.inf
    return np.asarray(worst.min(axis=1) > std**2)
