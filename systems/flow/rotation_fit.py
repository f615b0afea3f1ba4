"""The rotation between two clouds of points, and its refinement in the picture, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.plumb_bob import distort
from systems.small_matrices import eigen, multiply, rotation_of_quaternion, turn

Array = NDArray[np.float64]

# Of the information about the three axes, least over most: points within a few hundredths of a
# pixel do not tell a turn.
_LEAST_SPREAD = 1e-10
_STEPS = 3  # of Newton's method at most
_SETTLED = 1e-8  # rad, a step after which no other is worth its time: less than 1e-4 px


def nearest_turn(before: Array, after: Array) -> Array:
    """Returns the rotation (3, 3) with `after` nearest to `before` turned by it.

    Args:
        before: (n, 3).
        after: (n, 3).

    Source: Davenport's q-method: Keat, "Analysis of least-squares attitude determination routine
    DOAOP", 1977.
    """
    R = np.empty((3, 3))
    _nearest_turn(packed(before), packed(after), R)
    return R


@compiled("void(f8[:,::1], f8[:,::1], f8[:,::1])")
def _nearest_turn(before: Array, after: Array, R: Array) -> None:
    """Writes the rotation with the largest trace of R' B: its quaternion is an eigenvector."""
    B = np.zeros((3, 3))
    for k in range(len(before)):
        for i in range(3):
            for j in range(3):
                B[i, j] += after[k, i] * before[k, j]
    K, values, vectors = np.empty((4, 4)), np.empty(4), np.empty((4, 4))
    trace = B[0, 0] + B[1, 1] + B[2, 2]
    K[0, 0] = trace
    for i in range(3):
        for j in range(3):
            K[1 + i, 1 + j] = B[i, j] + B[j, i]
        K[1 + i, 1 + i] -= trace
        a, b = (i + 1) % 3, (i + 2) % 3
        K[0, 1 + i] = K[1 + i, 0] = B[b, a] - B[a, b]
    eigen(K, values, vectors)
    best = 0
    for k in range(1, 4):
        if values[k] > values[best]:
            best = k
    rotation_of_quaternion(vectors[:, best], R)


@compiled("i8(f8[:,::1], f8[:,::1], f8, f8[:,::1], b1[::1])")
def common_turn(
    before: Array, after: Array, least: float, R: Array, together: NDArray[np.bool_]
) -> int:
    """Writes the nearest turn of all points and which agree with it; returns how many do.

    Args:
        before: (n, 3).
        after: (n, 3).
        least: of points b and a that agree, the product b'R a is greater.
        R: (3, 3), written.
        together: (n,), written.
    """
    _nearest_turn(before, after, R)
    count = 0
    for k in range(len(before)):
        product = 0.0
        for i in range(3):
            product += after[k, i] * (
                R[i, 0] * before[k, 0] + R[i, 1] * before[k, 1] + R[i, 2] * before[k, 2]
            )
        together[k] = product > least
        count += together[k]
    return count


@compiled(
    "Tuple((i8, f8))(f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8, f8,"
    " f8[:,::1], f8[:,::1])"
)
def refine_turn(
    points: Array,
    pixels: Array,
    K: Array,
    D: Array,
    R_SC: Array,
    p_SC: Array,
    inlier_px: float,
    enough: float,
    R: Array,
    inverse: Array,
) -> tuple[int, float]:
    """Refines the rotation that carries points of the shell to where pixels show them.

    Least squares in the picture, over the points that are then nearer than `inlier_px`.

    Args:
        points: (n, 3) m, in S, before the rotation.
        pixels: (n, 2) px, after it.
        K: (3, 3) camera matrix, px.
        D: (5,) distortion.
        R_SC: (3, 3) of the optical frame in S.
        p_SC: (3,) m.
        inlier_px: px.
        enough: so many have to agree.
        R: (3, 3), changed.
        inverse: (3, 3) of the information about a small turn of the body, written, rad^2/px^2.

    Returns:
        How many agree, 0 when they are too few or do not tell a turn, and the sum of their squared
        errors after the last step, px^2.
    """
    information, inner = np.empty((3, 3)), np.empty((3, 3))
    g, step, values, p, row = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((2, 3))
    axes, turned, by_point = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
    count, squares = 0, 0.0
    for _ in range(_STEPS):
        count, squares = 0, 0.0
        g[:], information[:] = 0.0, 0.0
        for n in range(len(points)):
            for i in range(3):
                p[i] = R[i, 0] * points[n, 0] + R[i, 1] * points[n, 1] + R[i, 2] * points[n, 2]
            x, y, z = 0.0, 0.0, 0.0
            for i in range(3):
                x += (p[i] - p_SC[i]) * R_SC[i, 0]
                y += (p[i] - p_SC[i]) * R_SC[i, 1]
                z += (p[i] - p_SC[i]) * R_SC[i, 2]
            x, y = x / z, y / z
            bent_x, bent_y, by_x, by_y, across = distort(x, y, D)
            ex = pixels[n, 0] - (K[0, 0] * bent_x + K[0, 2])
            ey = pixels[n, 1] - (K[1, 1] * bent_y + K[1, 2])
            if not ex * ex + ey * ey < inlier_px * inlier_px:
                continue
            count += 1
            squares += ex * ex + ey * ey
            fx, fy = K[0, 0] / z, K[1, 1] / z
            by_point[0, 0], by_point[0, 1] = fx * by_x, fx * across
            by_point[1, 0], by_point[1, 1] = fy * across, fy * by_y
            by_point[0, 2] = -fx * (by_x * x + across * y)
            by_point[1, 2] = -fy * (across * x + by_y * y)
            # A turn d of the body moves a point of the shell by -d x p = p x d, and g . (p x d) is
            # (g x p) . d.
            for a in range(2):
                gx, gy, gz = 0.0, 0.0, 0.0
                for i in range(3):
                    gx += by_point[a, i] * R_SC[0, i]
                    gy += by_point[a, i] * R_SC[1, i]
                    gz += by_point[a, i] * R_SC[2, i]
                row[a, 0] = gy * p[2] - gz * p[1]
                row[a, 1] = gz * p[0] - gx * p[2]
                row[a, 2] = gx * p[1] - gy * p[0]
            for i in range(3):
                g[i] += row[0, i] * ex + row[1, i] * ey
                for j in range(3):
                    information[i, j] += row[0, i] * row[0, j] + row[1, i] * row[1, j]
        if count < enough:
            return 0, 0.0
        eigen(information, values, axes)
        if values.min() < _LEAST_SPREAD * values.max():
            return 0, 0.0
        for i in range(3):
            for j in range(3):
                inner[i, j] = axes[j, i] / values[i]
        multiply(axes, inner, inverse)
        square = 0.0
        for i in range(3):
            step[i] = -(inverse[i, 0] * g[0] + inverse[i, 1] * g[1] + inverse[i, 2] * g[2])
            square += step[i] * step[i]
            squares += step[i] * g[i]  # what the step takes away
        turn(step, R, turned)
        R[:] = turned
        if square < _SETTLED * _SETTLED:
            break
    return count, max(squares, 0.0)
