"""What a measurement does to the state of `shell_model`, compiled: one call a measurement.

What the symbols mean is said there; the motion is in `shell_arithmetic`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.estimators.shell_arithmetic import (
    MOUNTING,
    ROCK,
    SCALE,
    SIZE,
    STEP,
    THETA,
    add_cross,
    stand,
    straighten,
    turned,
)
from systems.small_matrices import (
    congruence,
    multiply,
    rotation_of,
    rotation_vector_of,
    solve_positive,
)

Array = NDArray[np.float64]


@compiled()
def expect_flow(
    x: Array, way: Array, seen: Array, T: Array, rock_tilt: Array, expected: Array, H: Array
) -> None:
    """Writes the increment that the flow is to tell (3,) rad, and its derivative (3, SIZE).

    Args:
        x: (n,) at the end of the interval.
        way: (3,) rad, what multiplies the flow's errors.
        seen: (3,) rad.
        T: (3, 3, 3) what a tilt of the camera does.
        rock_tilt: (3, 2) how rocking tilts it.
        expected: (3,), written.
        H: (3, SIZE), written.
    """
    tilt, by_tilt = np.empty(3), np.empty((3, 3))
    H[:] = 0.0
    for i in range(3):
        tilt[i] = rock_tilt[i, 0] * x[ROCK] + rock_tilt[i, 1] * x[ROCK + 1]
    for i in range(3):
        for k in range(3):
            H[i, MOUNTING + k] = T[i, 0, k] * way[0] + T[i, 1, k] * way[1] + T[i, 2, k] * way[2]
            by_tilt[i, k] = H[i, MOUNTING + k]
            for m in range(3):
                H[i, STEP + k] += T[i, k, m] * (x[MOUNTING + m] + tilt[m])
    add_cross(tilt, 1.0, H, STEP)
    add_cross(way, -1.0, by_tilt, 0)
    for i in range(3):
        scale = x[SCALE + 1] if i == 2 else x[SCALE]
        H[i, SCALE + (1 if i == 2 else 0)] = way[i]
        H[i, STEP + i] += 1.0 + scale
        expected[i] = seen[i] + scale * way[i]
        for k in range(3):
            expected[i] += H[i, MOUNTING + k] * x[MOUNTING + k] + by_tilt[i, k] * tilt[k]
            for a in range(2):
                H[i, ROCK + a] += by_tilt[i, k] * rock_tilt[k, a]


@compiled()
def correct(
    R: Array,
    x: Array,
    P: Array,
    H: Array,
    y: Array,
    noise: Array,
    gate: float,
    R_after: Array,
    x_after: Array,
    P_after: Array,
) -> float:
    """Corrects a state by an innovation, unless it is beyond the gate.

    Args:
        R: (3, 3).
        x: (n,).
        P: (n, n).
        H: (m, k) derivative of the measurement by the first k of the state.
        y: (m,) the innovation.
        noise: (m, m).
        gate: largest squared Mahalanobis distance that is taken.
        R_after: (3, 3), written if it is taken, as the others.
        x_after: (n,).
        P_after: (n, n).

    Returns:
        The squared Mahalanobis distance; NaN when the innovation's covariance is not positive.
    """
    n, (m, k) = len(x), H.shape
    PH = np.zeros((n, m))
    for c in range(k):
        for a in range(m):
            h = H[a, c]
            if h != 0.0:
                for i in range(n):
                    PH[i, a] += P[c, i] * h
    S = np.empty((m, m))
    for a in range(m):
        for b in range(a + 1):
            S[a, b] = (noise[a, b] + noise[b, a]) / 2
            for c in range(k):
                S[a, b] += (H[a, c] * PH[c, b] + H[b, c] * PH[c, a]) / 2
    # With S = L L' the rows of W are L^-1 of PH' and of y: K y = W' w, K PH' = W' W.
    if not solve_positive(S, y.copy()):
        return math.nan
    w, W = np.empty(m), np.empty((m, n))
    distance = 0.0
    for a in range(m):
        rest = y[a]
        for b in range(a):
            rest -= S[a, b] * w[b]
        w[a] = rest / S[a, a]
        distance += w[a] * w[a]
        for i in range(n):
            W[a, i] = PH[i, a]
        for b in range(a):
            for i in range(n):
                W[a, i] -= S[a, b] * W[b, i]
        for i in range(n):
            W[a, i] /= S[a, a]
    if not distance <= gate:
        return distance
    for i in range(n):
        x_after[i] = x[i]
        for a in range(m):
            x_after[i] += W[a, i] * w[a]
        # (I - K H) P (I - K H)' + K noise K', multiplied out: only rank m is changed.
        for j in range(n):
            P_after[i, j] = P[i, j]
        for a in range(m):
            share = W[a, i]
            for j in range(n):
                P_after[i, j] -= share * W[a, j]
    E, bent = np.empty((3, 3)), np.empty((3, 3))
    rotation_of(x_after[THETA : THETA + 3], E)
    multiply(E, R, bent)
    straighten(bent, R_after)
    for i in range(3):
        x_after[THETA + i] = x_after[STEP + i] = 0.0
    return distance


@compiled(
    "f8(f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8, f8[:,:,::1], f8[:,::1],"
    " f8[:,::1], f8[::1], f8[:,::1])",
)
def weigh_flow(
    R: Array,
    x: Array,
    P: Array,
    seen: Array,
    told: Array,
    noise: Array,
    gate: float,
    T: Array,
    rock_tilt: Array,
    R_after: Array,
    x_after: Array,
    P_after: Array,
) -> float:
    """Corrects a state by an increment told (3,) rad with covariance (3, 3).

    The arguments and what is returned are those of `expect_flow` and `correct`.
    """
    y, H = np.empty(3), np.empty((3, SIZE))
    expect_flow(x, told, seen, T, rock_tilt, y, H)
    for i in range(3):
        y[i] = told[i] - y[i]
    return correct(R, x, P, H, y, noise, gate, R_after, x_after, P_after)


@compiled()
def expect_marker(
    R: Array, x: Array, at: int, arm: float, reach: float, R_told: Array, p_told: Array, H: Array
) -> None:
    """Writes the pose that a picture of a marker is to tell, and its derivative.

    Args:
        R: (3, 3).
        x: (n,).
        at: where the marker stands in x.
        arm: of the camera over the body's origin, m.
        reach: of that over the shell's centre, m.
        R_told: (3, 3), written.
        p_told: (3,), written, m.
        H: (6, n), written.
    """
    p, away, mounting = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    away_R, by_theta, cross = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    stand(R, x, reach, p)
    rotation_of(-x[at : at + 3], away)
    rotation_of(x[MOUNTING : MOUNTING + 3], mounting)
    multiply(away, R, away_R)
    multiply(away_R, mounting, R_told)
    add_cross(p, -1.0, cross, 0)
    multiply(away, cross, by_theta)
    H[:] = 0.0
    for i in range(3):
        H[i, at + i] = -1.0
        for k, part in ((ROCK, reach), (MOUNTING, arm)):
            H[3 + i, k], H[3 + i, k + 1] = part * away_R[i, 1], -part * away_R[i, 0]
        p_told[i] = arm * away_R[i, 2]
        for j in range(3):
            H[i, THETA + j], H[i, MOUNTING + j] = away[i, j], away_R[i, j]
            H[3 + i, THETA + j] = by_theta[i, j]
            p_told[i] += away[i, j] * p[j] - arm * away_R[i, j] * mounting[j, 2]
    add_cross(p_told, 1.0, H[3:], at)


@compiled(
    "f8(f8[:,::1], f8[::1], f8[:,::1], i8, f8, f8, f8[:,::1], f8[::1], f8[:,::1], f8,"
    " f8[:,::1], f8[::1], f8[:,::1])",
)
def weigh_marker(
    R: Array,
    x: Array,
    P: Array,
    at: int,
    arm: float,
    reach: float,
    R_told: Array,
    p_told: Array,
    noise: Array,
    gate: float,
    R_after: Array,
    x_after: Array,
    P_after: Array,
) -> float:
    """Corrects a state by a marker pose told, R (3, 3) and p (3,) m, with covariance (6, 6).

    The arguments and what is returned are those of `expect_marker` and `correct`.
    """
    R_expected, p, error = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    y, H = np.empty(6), np.empty((6, len(x)))
    expect_marker(R, x, at, arm, reach, R_expected, p, H)
    multiply(R_told, R_expected.T, error)
    rotation_vector_of(error, y[:3])
    for i in range(3):
        y[3 + i] = p_told[i] - p[i]
    return correct(R, x, P, H, y, noise, gate, R_after, x_after, P_after)


@compiled(
    "void(f8[:,::1], f8[::1], f8[::1], f8[::1], f8, f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8,"
    " f8[:,::1], f8[::1], f8[:,::1])",
)
def carry_marker_pose(
    R: Array,
    x: Array,
    gyro: Array,
    reference: Array,
    dt: float,
    R_told: Array,
    p_told: Array,
    covariance: Array,
    floor: Array,
    height_variance: float,
    R_now: Array,
    p_now: Array,
    noise: Array,
) -> None:
    """Writes what a marker pose told tells at the end of an interval.

    Args:
        R: (3, 3), as the others up to `dt` see `turned`.
        x: (n,).
        gyro: (3,).
        reference: (3,).
        dt: s.
        R_told: (3, 3).
        p_told: (3,) m.
        covariance: (6, 6).
        floor: (6, 6), is added to it.
        height_variance: m^2, is added along the normal.
        R_now: (3, 3), written.
        p_now: (3,), written.
        noise: (6, 6), written.
    """
    u, factor, E, about = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    turned(R, x, gyro, reference, dt, np.empty(0), u, factor)
    rotation_of(u, E)
    multiply(R_told, E, R_now)
    multiply(R_now, R_told.T, about)  # the shell's centre
    both, square = np.zeros((6, 6)), 0.0
    for i in range(3):
        p_now[i] = 0.0
        for j in range(3):
            p_now[i] += about[i, j] * p_told[j]
            both[i, j] = both[3 + i, 3 + j] = about[i, j]
        square += p_now[i] * p_now[i]
    congruence(both, covariance, noise)
    for i in range(6):
        for j in range(6):
            noise[i, j] += floor[i, j]
            if i >= 3 and j >= 3:
                noise[i, j] += height_variance * p_now[i - 3] * p_now[j - 3] / square
