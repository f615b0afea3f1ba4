"""Linear algebra of a few unknowns, compiled: for use within other compiled loops."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed

Array = NDArray[np.float64]

_SMALL = 1e-8  # rad^2; below, the series' next terms round away


@compiled()
def solve_positive(A: Array, b: Array) -> bool:
    """Solves A x = b of a symmetric positive A in place: b becomes x, A its Cholesky factor.

    Args:
        A: (n, n); only its lower half is read.
        b: (n,).

    Returns:
        False, with A and b spoilt, when A is not positive (or not finite).
    """
    n = len(b)
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= A[j, k] * A[j, k]
        if not (pivot > 0.0 and pivot < math.inf):
            return False
        root = math.sqrt(pivot)
        A[j, j] = root
        for i in range(j + 1, n):
            rest = A[i, j]
            for k in range(j):
                rest -= A[i, k] * A[j, k]
            A[i, j] = rest / root
    for i in range(n):
        rest = b[i]
        for k in range(i):
            rest -= A[i, k] * b[k]
        b[i] = rest / A[i, i]
    for i in range(n - 1, -1, -1):
        rest = b[i]
        for k in range(i + 1, n):
            rest -= A[k, i] * b[k]
        b[i] = rest / A[i, i]
    return True


@compiled()
def turn(w: Array, R: Array, turned: Array) -> None:
    """Writes exp([w]x) R (Rodrigues).

    Args:
        w: rotation vector in its first three entries, rad.
        R: (3, 3).
        turned: (3, 3), written; not R itself.
    """
    x, y, z = w[0], w[1], w[2]
    angle = math.sqrt(x * x + y * y + z * z)
    half = angle / 2
    sinc = math.sin(half) / half if half > 1e-9 else 1.0  # sin(h) / h
    a, b = sinc * math.cos(half), sinc * sinc / 2
    for j in range(3):
        u, v, t = R[0, j], R[1, j], R[2, j]
        # w x r, and w x (w x r)
        cx, cy, cz = y * t - z * v, z * u - x * t, x * v - y * u
        turned[0, j] = u + a * cx + b * (y * cz - z * cy)
        turned[1, j] = v + a * cy + b * (z * cx - x * cz)
        turned[2, j] = t + a * cz + b * (x * cy - y * cx)


@compiled()
def multiply(A: Array, B: Array, product: Array) -> None:
    """Writes A B. NumPy's own product needs SciPy when compiled, and is slower for a few rows."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[k, j]
            product[i, j] = total


@compiled()
def congruence(A: Array, P: Array, product: Array) -> None:
    """Writes A P A', (n, n), of a symmetric P (m, m) and A (n, m); not into A or P."""
    n, m = A.shape
    row = np.empty(m)
    for i in range(n):
        for k in range(m):
            row[k] = 0.0
            for j in range(m):
                row[k] += A[i, j] * P[j, k]
        for j in range(i + 1):
            total = 0.0
            for k in range(m):
                total += row[k] * A[j, k]
            product[i, j] = product[j, i] = total


@compiled("void(f8[::1], f8[:,::1])")
def rotation_of(w: Array, R: Array) -> None:
    """Writes exp([w]x) (Rodrigues) of a rotation vector w (3,) rad to R (3, 3)."""
    x, y, z = w[0], w[1], w[2]
    square = x * x + y * y + z * z
    if square > _SMALL:
        angle = math.sqrt(square)
        half = math.sin(angle / 2) / angle
        a, b = math.sin(angle) / angle, 2 * half * half
    else:
        a, b = 1 - square / 6, 0.5 - square / 24
    c = 1 - b * square
    R[0, 0], R[0, 1], R[0, 2] = c + b * x * x, b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, c + b * y * y, b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, c + b * z * z


@compiled("void(f8[:,::1], f8[::1])")
def rotation_vector_of(R: Array, w: Array) -> None:
    """Writes the rotation vector (3,) rad, of length 0 to pi, of a rotation R (3, 3).

    Through the quaternion's outer product with itself, whose largest row is well conditioned at
    every angle, half a turn included.
    """
    a, b, c = R[0, 0], R[1, 1], R[2, 2]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    largest = max(a + b + c, a - b - c, b - a - c, c - a - b)
    if largest == a + b + c:
        q = (1 + a + b + c, x, y, z)
    elif largest == a - b - c:
        q = (x, 1 + a - b - c, xy, xz)
    elif largest == b - a - c:
        q = (y, xy, 1 - a + b - c, yz)
    else:
        q = (z, xz, yz, 1 - a - b + c)
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = 2 * math.atan2(sine, abs(q[0])) / sine if sine > 0 else 0.0
    if q[0] < 0:
        scale = -scale
    for i in range(3):
        w[i] = scale * q[1 + i]


def folded(P: Array) -> Array:
    """Returns the lower half of a symmetric P (n, n), row by row: n (n + 1) / 2 numbers."""
    lower = np.empty(len(P) * (len(P) + 1) // 2)
    fold(packed(P), lower)
    return lower


def unfolded(lower: Array, n: int) -> Array:
    """Returns the first n rows and columns of what has been `folded`."""
    P = np.empty((n, n))
    unfold(packed(lower), P)
    return P


@compiled("void(f8[:,::1], f8[::1])")
def fold(P: Array, lower: Array) -> None:
    """Writes what `folded` returns; for compiled code too."""
    k = 0
    for i in range(len(P)):
        for j in range(i + 1):
            lower[k] = P[i, j]
            k += 1


@compiled("void(f8[::1], f8[:,::1])")
def unfold(lower: Array, P: Array) -> None:
    """Writes what `unfolded` returns; for compiled code too."""
    k = 0
    for i in range(len(P)):
        for j in range(i + 1):
            P[i, j] = P[j, i] = lower[k]
            k += 1


@compiled()
def rotation_of_quaternion(q: Array, R: Array) -> None:
    """Writes the rotation (3, 3) of a quaternion w, x, y, z of any length but 0."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    s = 2 / (w * w + x * x + y * y + z * z)
    R[0, 0], R[0, 1], R[0, 2] = 1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)


@compiled()
def eigen(A: Array, values: Array, vectors: Array) -> None:
    """Writes the eigenvalues (n,), in no order, and eigenvectors of a symmetric A (n, n).

    By Jacobi's rotations, to rounding error; A is spoilt.

    Args:
        A: changed.
        values: written.
        vectors: (n, n), written; the columns.
    """
    n = len(A)
    vectors[:] = 0.0
    for i in range(n):
        vectors[i, i] = 1.0
    for _ in range(30):  # six do
        rest, size = 0.0, 0.0
        for i in range(n):
            size += A[i, i] * A[i, i]
            for j in range(i):
                rest += A[i, j] * A[i, j]
        if not rest > 1e-34 * size:
            break
        for i in range(1, n):
            for j in range(i):
                if A[i, j] == 0.0:
                    continue
                half = (A[j, j] - A[i, i]) / (2 * A[i, j])
                t = math.copysign(1.0, half) / (abs(half) + math.hypot(half, 1.0))
                c = 1 / math.hypot(t, 1.0)
                s = t * c
                for k in range(n):
                    a, b = A[k, i], A[k, j]
                    A[k, i], A[k, j] = c * a - s * b, s * a + c * b
                for k in range(n):
                    a, b = A[i, k], A[j, k]
                    A[i, k], A[j, k] = c * a - s * b, s * a + c * b
                    a, b = vectors[k, i], vectors[k, j]
                    vectors[k, i], vectors[k, j] = c * a - s * b, s * a + c * b
    for i in range(n):
        values[i] = A[i, i]
