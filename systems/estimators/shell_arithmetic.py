"""The arithmetic of `shell_model`, compiled: one call a step or a measurement.

What the symbols mean is said there. Turns of an interval come as their parts: the integrals of gyro
and reference, the length, the rates at both ends, and the way that the flow tells (of size 0 for
none).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.small_matrices import congruence, multiply, rotation_of, solve_positive

Array = NDArray[np.float64]

# Where each part of the state begins.
THETA, BIAS, MOUNTING, SCALE, DELAY, ROCK, GYRO, STEP, SIZE = 0, 3, 6, 9, 11, 12, 14, 23, 26
_NOISES = 8  # of the step (3), of the rock (2), of the bias (3)


@compiled(
    "void(f8[:,::1], f8[::1], f8[::1], f8[::1], f8, f8[::1], f8[::1], f8[::1])",
)
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


@compiled(
    "void(f8[:,::1], f8[::1], f8[::1], f8[::1], f8, f8[::1], f8[::1], f8[::1], f8[:,::1], f8,"
    " f8[::1], f8[:,::1], f8[:,::1])",
)
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


@compiled("void(f8[:,::1], f8[::1], f8[::1], f8, f8[:,::1], f8[::1], f8[::1])")
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


@compiled("void(f8[:,::1], f8[::1], f8, f8[::1])")
def stand(R: Array, x: Array, reach: float, p: Array) -> None:
    """Writes where the body's origin is (3,) m: `reach` (m) up the normal that it rocks about."""
    a, b = -x[ROCK + 1], x[ROCK]
    far = reach / math.sqrt(a * a + b * b + 1)
    for i in range(3):
        p[i] = far * (R[i, 0] * a + R[i, 1] * b + R[i, 2])


@compiled("void(f8[:,::1], f8[::1], f8[::1], f8[::1], f8, f8, f8, f8[:,::1], f8[::1])")
def pose_after(
    R: Array,
    x: Array,
    gyro: Array,
    reference: Array,
    dt: float,
    fading: float,
    reach: float,
    moved: Array,
    p: Array,
) -> None:
    """Writes rotation (3, 3) and place (3,) m at the end of an interval; see `turned`, `carry`."""
    u, factor, change, after = np.empty(3), np.empty(3), np.empty(2), np.empty(SIZE)
    turned(R, x, gyro, reference, dt, np.empty(0), u, factor)
    carry(R, x[:SIZE], u, fading, moved, after, change)
    stand(moved, after, reach, p)


@compiled("void(f8[:,::1], f8[::1], f8[:,::1], f8, f8[:,::1])")
def pose_covariance(R: Array, x: Array, P: Array, reach: float, covariance: Array) -> None:
    """Writes the covariance (6, 6) of rotation and place, of P (SIZE, SIZE); see `stand`."""
    p, H = np.empty(3), np.zeros((6, SIZE))
    stand(R, x, reach, p)
    _add_cross(p, -1.0, H[3:], THETA)
    for i in range(3):
        H[i, THETA + i] = 1.0
        H[3 + i, ROCK], H[3 + i, ROCK + 1] = reach * R[i, 1], -reach * R[i, 0]
    congruence(H, P, covariance)


@compiled("void(f8[:,::1], f8[:,::1], f8[:,::1], f8[::1])")
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


@compiled(
    "void(f8[::1], f8[::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1])",
)
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
    _add_cross(tilt, 1.0, H, STEP)
    _add_cross(way, -1.0, by_tilt, 0)
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
def _add_cross(v: Array, sign: float, A: Array, column: int) -> None:
    """Adds the matrix of the cross product by v (3,) to three columns of A."""
    x, y, z = sign * v[0], sign * v[1], sign * v[2]
    A[0, column + 1] -= z
    A[0, column + 2] += y
    A[1, column] += z
    A[1, column + 2] -= x
    A[2, column] -= y
    A[2, column + 1] += x


@compiled(
    "f8(f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8,"
    " f8[:,::1], f8[::1], f8[:,::1])",
)
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


@compiled()
def straighten(bent: Array, R: Array) -> None:
    """Writes the rotation next to a product of rotations, as `angles.nearest_rotation`."""
    for i in range(3):
        for j in range(3):
            R[i, j] = 1.5 * bent[i, j]
            for k in range(3):
                square = bent[0, k] * bent[0, j] + bent[1, k] * bent[1, j] + bent[2, k] * bent[2, j]
                R[i, j] -= 0.5 * bent[i, k] * square
