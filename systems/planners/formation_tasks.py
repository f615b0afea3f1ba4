"""What a formation's mover is told, and which robots are known well enough to tell it of."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
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
    way = [task.start.tolist(), *task.points.tolist(), task.target.tolist()]
    length = sum(map(math.dist, way, way[1:]))
    return length if math.isfinite(length) else 0.0


def not_found(covariance: Array, std: float) -> NDArray[np.bool_]:
    """Returns which robots are known well from no other, (N,).

    What matters is where they are from each other: from the start all get to be known less and
    less.

    Args:
        covariance: (3 N, 3 N) of their poses [x, y, theta].
        std: of the place against another's, along the worst axis, m.
    """
    best = np.empty(len(covariance) // 3)
    _least_variances(packed(covariance), best)
    return best > std**2


@compiled("void(f8[:,::1], f8[::1])")
def _least_variances(P: Array, best: Array) -> None:
    """Finds how well each robot is known from the one from which it is known best.

    Args:
        P: (3 N, 3 N), see `not_found`.
        best: (N,) written: variance along the worst axis, m^2; inf where P tells nothing.
    """
    best[:] = math.inf
    for i in range(0, len(P), 3):
        for j in range(0, i, 3):
            xx = P[i, i] + P[j, j] - P[i, j] - P[j, i]
            yy = P[i + 1, i + 1] + P[j + 1, j + 1] - P[i + 1, j + 1] - P[j + 1, i + 1]
            xy = P[i, i + 1] + P[j, j + 1] - P[i, j + 1] - P[j, i + 1]
            worst = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
            if worst < best[i // 3]:  # not NaN
                best[i // 3] = worst
            if worst < best[j // 3]:
                best[j // 3] = worst
