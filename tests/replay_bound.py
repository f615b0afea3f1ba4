"""How far dead reckoning is off at the least, whoever does it: no filter, no simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.replay_world import RATE, WANDER, WANDER_TIME, Drive, Truth

Array = NDArray[np.float64]


def least_covariance(drive: Drive, truth: Truth) -> Array:
    """Returns the covariance (2, 2) of the position at the end of the blind stretch, m^2.

    It is that of an oracle which at the beginning of the stretch is told pose, mean slip and the
    slip of that moment, and feels every turn exactly: what is left is how the slip wanders from
    there, an Ornstein-Uhlenbeck process whose covariance, given where it began, is exp(-|s - t|) -
    exp(-(s + t)) of its variance, times in units of its correlation time.
    """
    first, last = (int(np.searchsorted(drive.t, when - 1e-9)) for when in truth.blind)
    s = (drive.t[first:last] - truth.blind[0]) / WANDER_TIME
    given = np.exp(-np.abs(s[:, None] - s)) - np.exp(-(s[:, None] + s))
    heading = drive.pose[first:last, 2]
    steps = drive.command[first:last, :1] / RATE * np.stack([np.cos(heading), np.sin(heading)], 1)
    return np.asarray((truth.slip * WANDER) ** 2 * steps.T @ given @ steps)
