"""Perspective-n-point by least squares: many small problems at once, with covariance.

Every function works on a batch: b independent problems of m points each. The unknown is `X_CF`,
the pose of an object's frame F in the optical frame C. Tangent: rotation first, a small rotation
vector in C (the parent), then the position in C.

The camera comes in as rays (x/z, y/z of the measured pixels) and the derivative of the pixels by
the rays, both from `PinholeCamera.rays`. Their product with an error of the ray is, to first order,
the error in pixels of the distorted picture: lens and calibration cost nothing in the iterations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, in_rows
from systems.small_matrices import solve_positive, turn

Array = NDArray[np.float64]

_DAMPING_START = 1e-6  # of the normal matrix' diagonal
_DAMPING_END = 1e6  # no step of this length is an improvement: the minimum is reached
_MIN_DEPTH = 1e-6  # m; a point nearer to the camera's plane has no image
_IDENTITY = np.eye(3)
_CROSS = np.zeros((3, 9))  # w to [w]x, row by row
_CROSS[[0, 1, 2], [7, 2, 3]], _CROSS[[0, 1, 2], [5, 6, 1]] = 1.0, -1.0


@dataclass(frozen=True, eq=False)
class PnpSolution:
    """b poses and how well they explain the pixels.

    Attributes:
        R: (b, 3, 3) `R_CF`.
        p: (b, 3) `p_CF`, m.
        squared_error: (b,) sum of squared residuals, px^2; inf where a point has no image.
        information: (b, 6, 6) J'J of the residuals, for noise of 1 px.
    """

    R: Array
    p: Array
    squared_error: Array
    information: Array

    def __len__(self) -> int:
        return len(self.R)

    def select(self, order: list[int]) -> PnpSolution:
        """Returns the poses picked by their numbers, in that order."""
        if order == list(range(len(self))):
            return self
        return PnpSolution(
            self.R[order], self.p[order], self.squared_error[order], self.information[order]
        )


def rotation_from_vector(w: Array) -> Array:
    """Returns exp([w]x) of (..., 3) rotation vectors: (..., 3, 3) (Rodrigues)."""
    half_angle = np.sqrt((w * w).sum(axis=-1))[..., None, None] / 2
    sinc = np.sinc(half_angle / np.pi)  # sin(h) / h, and 1 at h = 0
    W = cross_matrix(w)
    return _IDENTITY + sinc * np.cos(half_angle) * W + sinc * sinc / 2 * (W @ W)


def cross_matrix(w: Array) -> Array:
    """Returns [w]x of (..., 3) vectors: (..., 3, 3)."""
    return (w @ _CROSS).reshape(*w.shape, 3)


def squared_errors(R: Array, p: Array, points: Array, rays: Array, by_ray: Array) -> Array:
    """Returns the sum of squared residuals of each problem: (...) px^2, inf behind the camera.

    What stands for the problems, `...`, broadcasts.

    Args:
        R: (..., 3, 3) `R_CF`.
        p: (..., 3) `p_CF`, m.
        points: (..., m, 3), in F, m.
        rays: (..., m, 2), measured.
        by_ray: (..., m, 2, 2) derivative of the pixels by the rays, px.
    """
    p_C = points @ R.swapaxes(-1, -2) + p[..., None, :]
    behind = _keep_before_camera(p_C)
    residual = by_ray @ (p_C[..., :2] / p_C[..., 2:] - rays)[..., None]
    error = (residual * residual).sum(axis=(-1, -2, -3))
    error[behind] = np.inf
    return error


def squared_errors_by_object(
    R: Array, p: Array, points: Array, rays: Array, by_ray: Array
) -> Array:
    """Returns what each of b poses leaves of each of n objects' points: (b, n), as above.

    Args:
        R: (b, 3, 3).
        p: (b, 3).
        points: (n, m, 3).
        rays: (n, m, 2).
        by_ray: (n, m, 2, 2).
    """
    m = points.shape[1]
    errors = np.empty((len(R), len(points)))
    _squared_errors(
        in_rows(R, 3, 3), in_rows(p, 3), in_rows(points, m, 3), in_rows(rays, m, 2),
        in_rows(by_ray, m, 2, 2), errors,
    )  # fmt: skip
    return errors


@compiled("void(f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,:,::1], f8[:,::1])")
def _squared_errors(
    R: Array, p: Array, points: Array, rays: Array, by_ray: Array, errors: Array
) -> None:
    for i in range(len(R)):
        for j in range(len(points)):
            error = 0.0
            for k in range(points.shape[1]):
                a, b, c = points[j, k, 0], points[j, k, 1], points[j, k, 2]
                x = R[i, 0, 0] * a + R[i, 0, 1] * b + R[i, 0, 2] * c + p[i, 0]
                y = R[i, 1, 0] * a + R[i, 1, 1] * b + R[i, 1, 2] * c + p[i, 1]
                z = R[i, 2, 0] * a + R[i, 2, 1] * b + R[i, 2, 2] * c + p[i, 2]
                if not z >= _MIN_DEPTH:
                    error = math.inf
                    break
                ex, ey = x / z - rays[j, k, 0], y / z - rays[j, k, 1]
                for m in range(2):
                    e = by_ray[j, k, m, 0] * ex + by_ray[j, k, m, 1] * ey
                    error += e * e
            errors[i, j] = error


def _keep_before_camera(p_C: Array) -> NDArray[np.bool_]:
    """Returns which problems (...) have one of their points (..., m, 3) behind the camera.

    Their points are moved to where computing with them does no harm.
    """
    behind = np.asarray((p_C[..., 2] < _MIN_DEPTH).any(axis=-1))
    if behind.any():
        p_C[behind] = (0.0, 0.0, 1.0)
    return behind


@compiled()
def normal_equations(
    R: Array, p: Array, points: Array, rays: Array, by_ray: Array, product: Array
) -> None:
    """Writes [J r]'[J r], (7, 7), of one problem: J'J, J'r and the squared error r'r.

    With a point behind the camera the error is infinite and the rest zero.
    """
    product[:] = 0.0
    row = np.empty(7)
    for k in range(len(points)):
        a, b, c = points[k]
        # R p_F, then the point in C.
        arm_x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        arm_y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
        arm_z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        depth = arm_z + p[2]
        if not depth >= _MIN_DEPTH:
            product[:] = 0.0
            product[6, 6] = np.inf
            return
        x, y = (arm_x + p[0]) / depth, (arm_y + p[1]) / depth
        for i in range(2):
            # Derivative by position and, through p_C = w x arm + ..., by rotation.
            by_x, by_y = by_ray[k, i, 0] / depth, by_ray[k, i, 1] / depth
            by_z = -(by_x * x + by_y * y)
            row[0] = arm_y * by_z - arm_z * by_y
            row[1] = arm_z * by_x - arm_x * by_z
            row[2] = arm_x * by_y - arm_y * by_x
            row[3], row[4], row[5] = by_x, by_y, by_z
            row[6] = by_ray[k, i, 0] * (x - rays[k, 0]) + by_ray[k, i, 1] * (y - rays[k, 1])
            for m in range(7):
                for n in range(m + 1):
                    product[m, n] += row[m] * row[n]
    for m in range(7):
        for n in range(m):
            product[n, m] = product[m, n]


@compiled(
    "f8[:,:,::1](f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,:,::1], i8, f8, f8)"
)
def minimise(
    R: Array,
    p: Array,
    points: Array,
    rays: Array,
    by_ray: Array,
    iterations: int,
    tolerance: float,
    hopeless: float,
) -> Array:
    """Moves R and p to the minima (see `refine`); returns [J r]'[J r] there, (b, 7, 7)."""
    b = len(R)
    product, trial = np.empty((b, 7, 7)), np.empty((7, 7))
    for i in range(b):
        k = i * len(points) // b
        normal_equations(R[i], p[i], points[k], rays[k], by_ray[k], product[i])
    damping = np.full(b, _DAMPING_START)
    active = np.isfinite(product[:, 6, 6])
    damped, step = np.empty((6, 6)), np.empty(6)
    R_new, p_new = np.empty((3, 3)), np.empty(3)
    for _ in range(iterations):
        if not active.any():
            break
        for i in range(b):
            if not active[i]:
                continue
            k, here = i * len(points) // b, product[i]
            damped[:] = here[:6, :6]
            for m in range(6):
                damped[m, m] *= 1 + damping[i]
                step[m] = -here[m, 6]
            if not solve_positive(damped, step):
                damping[i] *= 10.0
                active[i] = damping[i] < _DAMPING_END
                continue
            # What the step would gain is known beforehand: the last look is spared.
            if not -np.sum(step * here[:6, 6]) >= tolerance * (1 + here[6, 6]):
                active[i] = False
                continue
            turn(step, R[i], R_new)
            p_new[:] = p[i] + step[3:]
            normal_equations(R_new, p_new, points[k], rays[k], by_ray[k], trial)
            if trial[6, 6] <= here[6, 6]:
                R[i], p[i], product[i] = R_new, p_new, trial
                damping[i] *= 0.1
            else:
                damping[i] *= 10.0
                active[i] = damping[i] < _DAMPING_END
        best = int(np.argmin(product[:, 6, 6]))
        if not active[best]:
            for i in range(b):
                active[i] &= product[i, 6, 6] <= product[best, 6, 6] + hopeless
    return product


def refine(
    R: Array,
    p: Array,
    points: Array,
    rays: Array,
    by_ray: Array,
    *,
    iterations: int = 40,
    tolerance: float = 1e-8,
    hopeless: float = np.inf,
) -> PnpSolution:
    """Minimises the reprojection error of b problems by Levenberg-Marquardt, from given poses.

    Args:
        R: (b, 3, 3) `R_CF` to start from.
        p: (b, 3) `p_CF` to start from, m.
        points: (b, m, 3), in F, m; or (m, 3) for all, or (b / s, m, 3), each for s starts in turn.
        rays: (b, m, 2) likewise, measured.
        by_ray: (b, m, 2, 2) likewise, derivative of the pixels by the rays, px.
        iterations: at most so many steps; four or five do, unless the start lies on a saddle, as a
            marker's second pose does where there is but one minimum.
        tolerance: a problem is done when a step promises to lower its error by less than this part
            of it, or by less than this, px^2.
        hopeless: once the best problem is done, one whose error still exceeds that one's by more
            than this is left where it is: for starts that compete for one pose.

    Returns:
        The local minima. A problem whose start has a point behind the camera keeps its start and
        an infinite error.
    """
    m = points.shape[-2]
    R, p = np.array(R, order="C"), np.array(p, order="C")
    points, rays = in_rows(points, m, 3), in_rows(rays, m, 2)
    product = minimise(
        R, p, points, rays, in_rows(by_ray, m, 2, 2), iterations, tolerance, hopeless
    )
    return PnpSolution(R, p, product[:, 6, 6], product[:, :6, :6])


def covariance(information: Array, pixel_noise: float) -> Array:
    """Returns the covariance (b, 6, 6) of poses whose corners carry noise of `pixel_noise` (px).

    The Cramer-Rao bound at the solution: sigma^2 (J'J)^-1. A direction that the corners do not
    determine gets a huge variance, never NaN.
    """
    inverses = np.empty(information.shape)
    if _inverses(in_rows(information, 6, 6), in_rows(inverses, 6, 6)):
        return pixel_noise**2 * inverses
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-9 * np.maximum(values[..., -1:], 1e-9))
    return pixel_noise**2 * (vectors / values[..., None, :]) @ vectors.swapaxes(-1, -2)


@compiled("b1(f8[:,:,::1], f8[:,:,::1])")
def _inverses(A: Array, inverses: Array) -> bool:
    """Writes the inverses of positive (6, 6) matrices; False when one is hardly one."""
    factor, column = np.empty((6, 6)), np.empty(6)
    for i in range(len(A)):
        for j in range(6):
            factor[:] = A[i]
            column[:] = 0.0
            column[j] = 1.0
            if not solve_positive(factor, column):
                return False
            for k in range(6):
                # The square of a pivot is what its unknown has left, the others given.
                if factor[k, k] ** 2 < 1e-6 * A[i, k, k]:
                    return False
                inverses[i, k, j] = column[k]
    return True
