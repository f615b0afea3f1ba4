"""Refused marker poses that agree among themselves: has the robot been moved, or a marker?

A robot that was carried away, or that started from a wrong pose, refuses every marker pose from
then on. They all are off from the estimate by one and the same rigid motion, however it drives.
Noise, a picture that is frozen while the robot moves, or a marker that is confused with another are
not. So the first refused pose is kept with the estimate of that time; where the estimate has gone
since, put at the end of that refused pose, is where the next ones must lie.

One marker that was moved looks exactly like that, too: to tell it from a robot that was moved,
there must be another marker that says the same. The poses by several markers in one picture have
that witness (the localizer puts them together only if they fit); the time of their agreement counts
apart from that of all. Poses by single markers must agree for much longer, longer than a marker
stays alone in view. Whatever is accepted in between ends it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from systems.estimators.planar_kalman import mahalanobis

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Agreement:
    """The refused poses so far.

    Attributes:
        x: (3,) estimate at the time of the first of them.
        z: (3,) that first one.
        R: (3, 3) its covariance.
        last: stamp of the last that agreed with it, s.
        several: how long those by several markers have agreed, s.
        all: how long all have, s.
    """

    x: Array
    z: Array
    R: Array
    last: float
    several: float = 0.0
    all: float = 0.0

    SIZE = 18

    @staticmethod
    def from_vector(vector: Array) -> Agreement | None:
        """Returns it from a discrete state; None from NaN."""
        if math.isnan(vector[0]):
            return None
        return Agreement(
            vector[:3], vector[3:6], vector[6:15].reshape(3, 3), *map(float, vector[15:])
        )

    @staticmethod
    def to_vector(agreement: Agreement | None) -> Array:
        """Returns (SIZE,) for a discrete state; NaN for None."""
        if agreement is None:
            return np.full(Agreement.SIZE, np.nan)
        a = agreement
        return np.concatenate([a.x, a.z, a.R.ravel(), [a.last, a.several, a.all]])


def refused(
    before: Agreement | None,
    *,
    stamp: float,
    x: Array,
    P: Array,
    z: Array,
    R: Array,
    several: bool,
    gate: float,
    longest_gap: float,
) -> Agreement:
    """Weighs one more pose that was refused.

    Args:
        before: those before; None if the last one was accepted.
        stamp: time of the picture, s.
        x: (3,) the estimate at that time.
        P: (3, 3) its covariance; generous, since only what it gained since the first counts.
        z: (3,) the refused pose.
        R: (3, 3) its covariance.
        several: whether it rests on several markers.
        gate: squared Mahalanobis distance up to which it agrees.
        longest_gap: the time since the last one counts at most so much, s.

    Returns:
        The agreement with it; begun anew with it if it does not agree.
    """
    if before is None:
        return Agreement(x, z, R, stamp)
    turn = before.z[2] - before.x[2]
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    gone = rotation @ (x - before.x)
    # An error of the first pose's heading swings all that came after.
    swing = np.array([[1.0, 0.0, -gone[1]], [0.0, 1.0, gone[0]], [0.0, 0.0, 1.0]])
    spread = rotation @ P @ rotation.T + swing @ before.R @ swing.T
    if mahalanobis(before.z + gone, spread, z, R) > gate:
        return Agreement(x, z, R, stamp)
    gap = min(max(stamp - before.last, 0.0), longest_gap)
    return replace(
        before,
        last=max(stamp, before.last),
        several=before.several + gap * several,
        all=before.all + gap,
    )
