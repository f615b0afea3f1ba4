"""The motion of `shell_model`, compiled: one call a step. Measurements are in `shell_correction`.

What the symbols mean is said there. Turns of an interval come as their parts: the integrals of gyro
and reference, the length, the rates at both ends, and the way that the flow tells (of size 0 for
none).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.small_matrices import congruence, multiply, rotation_of

Array = NDArray[np.float64]

# Where each part of the state begins.
THETA, BIAS, MOUNTING, SCALE, DELAY, ROCK, GYRO, STEP, SIZE = 0, 3, 6, 9, 11, 12, 14, 23, 26
_NOISES = 8  # of the step (3), of the rock (2), of the bias (3)


@compiled()
def turned(
    R: Array,
    x: Array,
    gyro: Array,
    reference: Array,
    dt: float,
    way: Array,
    u: Array,
    factor: Array,
) -> None:
    """Writes the body's rotation over the shell (3,) rad, in B, and what scales multiply (3,)."""
    in_B, measured, relative, half = np.empty(3), np.empty(3), np.zeros(3), np.empty(3)
    moves = False
    for i in range(3):
        measured[i] = gyro[i] - dt * x[BIAS + i]
        in_B[i] = R[0, i] * reference[0] + R[1, i] * reference[1] + R[2, i] * reference[2]
        half[i] = (measured[i] - in_B[i]) / 2
        moves = moves or reference[i] != 0.0
    if moves:
        # Of the middle of the interval: seen from the body, the reference's axis turns meanwhile.
        E = np.empty((3, 3))
        rotation_of(half, E)
        for i in range(3):
            relative[i] = E[0, i] * in_B[0] + E[1, i] * in_B[1] + E[2, i] * in_B[2]
    for i in range(3):
        factor[i] = way[i] + relative[i] if len(way) else measured[i]
    for i in range(3):
        u[i] = measured[i] - relative[i]
        for j in range(3):
            u[i] += x[GYRO + 3 * i + j] * factor[j]


@compiled()
def transition(
    R: Array,
    x: Array,
    gyro: Array,
    reference: Array,
    dt: float,
    rate_before: Array,
    rate_after: Array,
    way: Array,
    rock_step: Array,
    rock_time: float,
    u: Array,
    F: Array,
    G: Array,
) -> None:
    """Writes the step (3,) rad and the derivatives of one, as `ShellModel.transition` gives them.

    Args:
        R: (3, 3), as the others up to `dt` see `turned`.
        x: (n,).
        gyro: (3,).
        reference: (3,).
        dt: s.
        rate_before: (3,).
        rate_after: (3,).
        way: (3,), or of size 0 for none.
        rock_step: (3, 2) what the flow sees of a change of the rock.
        rock_time: s.
        u: (3,), written.
        F: (SIZE, SIZE), written.
        G: (SIZE, 8), written.
    """
    factor = np.empty(3)
    turned(R, x, gyro, reference, dt, way, u, factor)
    J = np.zeros((3, SIZE))
    _differentiate_step(R, x, reference, dt, rate_before, rate_after, len(way) > 0, factor, J)
    half, E, middle = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        half[i] = u[i] / 2
    rotation_of(half, E)
    multiply(R, E, middle)
    fades = math.exp(-dt / rock_time)
    F[:], G[:] = 0.0, 0.0
    for k in range(STEP):
        F[k, k] = 1.0
    for i in range(3):
        for c in range(SIZE):
            F[STEP + i, c] = J[i, c]
            F[THETA + i, c] += (
                middle[i, 0] * J[0, c] + middle[i, 1] * J[1, c] + middle[i, 2] * J[2, c]
            )
        for j in range(3):
            G[THETA + i, j] = middle[i, j]
        G[STEP + i, i] = 1.0
        G[BIAS + i, 5 + i] = 1.0
        for k in range(2):
            F[STEP + i, ROCK + k] += (fades - 1) * rock_step[i, k]
            G[STEP + i, 3 + k] = rock_step[i, k]
    for k in range(2):
        F[ROCK + k, ROCK + k] = fades
        G[ROCK + k, 3 + k] = 1.0


@compiled()
def _differentiate_step(
    R: Array,
    x: Array,
    reference: Array,
    dt: float,
    rate_before: Array,
    rate_after: Array,
    has_way: bool,
    factor: Array,
    J: Array,
) -> None:
    """Writes the derivative (3, SIZE), zeros before, of the step by the state."""
    a, b, c = reference[0], reference[1], reference[2]
    by_theta = np.empty((3, 3))  # R' [reference]x
    for i in range(3):
        by_theta[i, 0] = R[1, i] * c - R[2, i] * b
        by_theta[i, 1] = R[2, i] * a - R[0, i] * c
        by_theta[i, 2] = R[0, i] * b - R[1, i] * a
    for i in range(3):
        J[i, DELAY] = rate_before[i] - rate_after[i]
        J[i, BIAS + i] = -dt
        for j in range(3):
            J[i, THETA + j] = -by_theta[i, j]
            J[i, GYRO + 3 * i + j] = factor[j]
            if has_way:
                for k in range(3):
                    J[i, THETA + j] += x[GYRO + 3 * i + k] * by_theta[k, j]
            else:
                J[i, BIAS + j] -= dt * x[GYRO + 3 * i + j]


@compiled()
def carry(
    R: Array, x: Array, u: Array, fading: float, moved: Array, after: Array, change: Array
) -> None:
    """Writes rotation and x after a step u (3,) rad, and by what the rock has faded (2,) rad.

    Args:
        R: (3, 3) before.
        x: (n,) before.
        u: (3,) rad.
        fading: -1 to 0, the part by which the rock changes.
        moved: (3, 3), written.
        after: (n,), written.
        change: (2,), written.
    """
    E, bent = np.empty((3, 3)), np.empty((3, 3))
    rotation_of(u, E)
    multiply(R, E, bent)
    straighten(bent, moved)
    after[:] = x
    for k in range(2):
        change[k] = fading * x[ROCK + k]
        after[ROCK + k] += change[k]


@compiled()
def stand(R: Array, x: Array, reach: float, p: Array) -> None:
    """Writes where the body's origin is (3,) m: `reach` (m) up the normal that it rocks about."""
    a, b = -x[ROCK + 1], x[ROCK]
    far = reach / math.sqrt(a * a + b * b + 1)
    for i in range(3):
        p[i] = far * (R[i, 0] * a + R[i, 1] * b + R[i, 2])


@compiled(
    "void(f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], f8, f8[::1], f8[::1], f8, f8[::1],"
    " f8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1])",
)
def predict(
    R: Array,
    x: Array,
    P: Array,
    gyro: Array,
    reference: Array,
    dt: float,
    rate_before: Array,
    rate_after: Array,
    lost: float,
    way: Array,
    noise: Array,
    rock_step: Array,
    moved: Array,
    after: Array,
    grown: Array,
    u: Array,
    seen: Array,
) -> None:
    """Writes the state at the end of an interval, as `ShellModel.predict` gives it.

    Args:
        R: (3, 3), as the others up to `rock_step` see `transition` and `Turn`.
        x: (n,).
        P: (n, n).
        gyro: (3,).
        reference: (3,).
        dt: s.
        rate_before: (3,).
        rate_after: (3,).
        lost: s.
        way: (3,) or of size 0.
        noise: (5,) see `ProcessNoise`.
        rock_step: (3, 2).
        moved: (3, 3), written: R after it.
        after: (n,), written: x.
        grown: (n, n), written: P.
        u: (3,), written: the step.
        seen: (3,), written: what the flow is to see of it.
    """
    rock_time = noise[4]
    F, G, Q, change = np.empty((SIZE, SIZE)), np.empty((SIZE, 8)), np.empty(_NOISES), np.empty(2)
    transition(
        R, x, gyro, reference, dt, rate_before, rate_after, way, rock_step, rock_time, u, F, G
    )
    Q[:3] = noise[0] * dt + noise[1] * lost
    Q[3:5] = -noise[3] * math.expm1(-2 * dt / rock_time)
    Q[5:] = noise[2] * dt
    grown[:] = P
    propagate(grown, F, G, Q)  # the markers stay where they are
    carry(R, x, u, math.expm1(-dt / rock_time), moved, after, change)
    for i in range(3):
        seen[i] = u[i] + rock_step[i, 0] * change[0] + rock_step[i, 1] * change[1]


@compiled()
def pose_after(
    R: Array,
    x: Array,
    gyro: Array,
    reference: Array,
    dt: float,
    rock_time: float,
    reach: float,
    moved: Array,
    p: Array,
) -> None:
    """Writes rotation (3, 3) and place (3,) m at the end of an interval; see `turned`, `carry`."""
    u, factor, change, after = np.empty(3), np.empty(3), np.empty(2), np.empty(SIZE)
    turned(R, x, gyro, reference, dt, np.empty(0), u, factor)
    carry(R, x[:SIZE], u, math.expm1(-dt / rock_time), moved, after, change)
    stand(moved, after, reach, p)


@compiled()
def pose_covariance(R: Array, x: Array, P: Array, reach: float, covariance: Array) -> None:
    """Writes the covariance (6, 6) of rotation and place, of P (SIZE, SIZE); see `stand`."""
    p, H = np.empty(3), np.zeros((6, SIZE))
    stand(R, x, reach, p)
    add_cross(p, -1.0, H[3:], THETA)
    for i in range(3):
        H[i, THETA + i] = 1.0
        H[3 + i, ROCK], H[3 + i, ROCK + 1] = reach * R[i, 1], -reach * R[i, 0]
    congruence(H, P, covariance)


@compiled()
def propagate(P: Array, F: Array, G: Array, Q: Array) -> None:
    """Changes P (n, n) to F P F' + G Q G'; beyond the first SIZE states F is 1 and G is 0.

    Only a few rows of F are not those of the identity; only theirs change.

    Args:
        P: changed.
        F: (SIZE, SIZE).
        G: (SIZE, 8).
        Q: (8,) variances.
    """
    n = len(P)
    rows = np.empty((SIZE, n))
    which, count = np.empty(SIZE, np.int64), 0
    for r in range(SIZE):
        same = True
        for c in range(SIZE):
            if F[r, c] != (1.0 if r == c else 0.0):
                same = False
        if same:
            continue
        new = rows[count]
        new[:] = 0.0
        for c in range(SIZE):
            f = F[r, c]
            if f != 0.0:
                for j in range(n):
                    new[j] += f * P[c, j]
        which[count] = r
        count += 1
    block = np.empty((count, count))  # of the changed rows and columns
    for a in range(count):
        for b in range(a + 1):
            total = 0.0
            for c in range(SIZE):
                total += rows[a, c] * F[which[b], c]
            block[a, b] = block[b, a] = total
    for a in range(count):
        for b in range(count):
            rows[a, which[b]] = block[a, b]
    for a in range(count):
        for j in range(n):
            P[which[a], j] = P[j, which[a]] = rows[a, j]
    for r in range(SIZE):
        for c in range(r + 1):
            total = 0.0
            for k in range(_NOISES):
                total += G[r, k] * Q[k] * G[c, k]
            if total != 0.0:
                P[r, c] += total
                P[c, r] = P[r, c]


@compiled()
def straighten(bent: Array, R: Array) -> None:
    """Writes the rotation next to a product of rotations, as `angles.nearest_rotation`."""
    for i in range(3):
        for j in range(3):
            R[i, j] = 1.5 * bent[i, j]
            for k in range(3):
                square = bent[0, k] * bent[0, j] + bent[1, k] * bent[1, j] + bent[2, k] * bent[2, j]
                R[i, j] -= 0.5 * bent[i, k] * square


@compiled()
def add_cross(v: Array, sign: float, A: Array, column: int) -> None:
    """Adds the matrix of the cross product by v (3,) to three columns of A."""
    x, y, z = sign * v[0], sign * v[1], sign * v[2]
    A[0, column + 1] -= z
    A[0, column + 2] += y
    A[1, column] += z
    A[1, column + 2] -= x
    A[2, column] -= y
    A[2, column + 1] += x
