"""What the beams of a turning lidar fall on, each from where the lidar was at its time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.compiled import compiled, in_rows, packed
from systems.messages import Scan
from systems.raycasting import SOLID_ARRAYS, SolidArrays, Solids, cast
from systems.small_matrices import multiply

Array = NDArray[np.float64]


def poses_before(twist: Array, ages: Array) -> Array:
    """Returns where a body was under a steady twist, seen from where it is now.

    Args:
        twist: (6,) of the body in its own axes, rotation first (rad/s, m/s).
        ages: (n,) how long ago, s.

    Returns:
        (n, 3, 4) rotations and translations (m): exp(-age [twist]) in SE(3) (Murray, Li, Sastry,
        "A mathematical introduction to robotic manipulation", 1994, proposition 2.9).
    """
    poses = np.empty((len(ages), 3, 4))
    _poses_before(packed(twist), packed(ages), poses)
    return poses


@compiled("void(f8[::1], f8[::1], f8[:,:,::1])")
def _poses_before(twist: Array, ages: Array, poses: Array) -> None:
    speed = max(math.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2), 1e-12)
    x, y, z = twist[0] / speed, twist[1] / speed, twist[2] / speed
    K = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    KK = np.empty((3, 3))
    multiply(K, K, KK)
    for n in range(len(ages)):
        angle = -speed * ages[n]
        s, c = math.sin(angle), 1 - math.cos(angle)
        for i in range(3):
            poses[n, i, 3] = angle * twist[3 + i] / speed
            for j in range(3):
                bent = c * K[i, j] + (angle - s) * KK[i, j]
                poses[n, i, 3] += bent * twist[3 + j] / speed
                poses[n, i, j] = s * K[i, j] + c * KK[i, j]
            poses[n, i, i] += 1.0


@dataclass(frozen=True, eq=False)
class Beams:
    """What the beams of a turn fall on, without noise.

    Attributes:
        ranges: (n, 3) m, at the right edge, in the middle and at the left edge of each beam; inf
            where nothing is within range_max.
        solids: (n, 3) which solid; -1 for none.
    """

    ranges: Array
    solids: NDArray[np.intp]


def cast_beams(
    scan: Scan,
    solids: Solids,
    X_WP: RigidTransform,
    X_PL: RigidTransform,
    *,
    twist: Array,
    divergence: float,
) -> Beams:
    """Returns what the beams of a turn fall on, each from where the lidar was at its time.

    Args:
        scan: the turn; its ranges are not looked at.
        solids: what there is to be hit.
        X_WP: pose of the body at the last ray.
        X_PL: pose of the lidar in the body.
        twist: (6,) of the body in its own axes, rotation first (rad/s, m/s), steady for the turn.
        divergence: full angle of the beam, rad.
    """
    n = len(scan)
    turn = np.array((scan.angle_min, scan.angle_increment, scan.time_increment, scan.range_max))
    ranges, entered = np.empty((n, 3)), np.empty((n, 3), np.intp)
    _cast_beams(
        turn, divergence, solids.arrays, in_rows(X_WP.GetAsMatrix34(), 4),
        in_rows(X_PL.GetAsMatrix34(), 4), packed(twist), ranges, entered,
    )  # fmt: skip
    return Beams(ranges, solids.numbers(entered))


@compiled(f"void(f8[::1], f8, {SOLID_ARRAYS}, f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], i8[:,::1])")
def _cast_beams(
    turn: Array,
    divergence: float,
    solids: SolidArrays,
    X_WP: Array,
    X_PL: Array,
    twist: Array,
    ranges: Array,
    entered: NDArray[np.intp],
) -> None:
    """Writes what beams of a turn [first angle, its step, the time's step, range] fall on."""
    n = len(ranges)
    origins, directions = np.empty((3 * n, 3)), np.empty((3 * n, 3))
    poses = np.empty((n, 3, 4))
    _poses_before(twist, turn[2] * np.arange(n - 1, -1, -1), poses)
    R_WB, R_WL = np.empty((3, 3)), np.empty((3, 3))
    for k in range(n):
        multiply(X_WP[:, :3], poses[k, :, :3], R_WB)
        multiply(R_WB, X_PL[:, :3], R_WL)
        for b in range(3):
            angle = turn[0] + k * turn[1] + divergence * (b - 1) / 2
            ahead, left = math.cos(angle), math.sin(angle)
            for i in range(3):
                place = X_WP[i, 3]
                for j in range(3):
                    place += R_WB[i, j] * X_PL[j, 3] + X_WP[i, j] * poses[k, j, 3]
                origins[3 * k + b, i] = place
                directions[3 * k + b, i] = ahead * R_WL[i, 0] + left * R_WL[i, 1]
    reach = np.full(3 * n, turn[3])
    cast(solids, origins, directions, reach, ranges.reshape(-1), entered.reshape(-1))
