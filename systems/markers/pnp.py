"""Perspective-n-point by least squares: many small problems at once, with covariance.

Every function works on a batch: b independent problems of m points each. The unknown is `X_CF`,
the pose of an object's frame F in the optical frame C. Tangent: rotation first, a small rotation
vector in C (the parent), then the position in C.

The camera comes in as rays (x/z, y/z of the measured pixels) and the derivative of the pixels by
the rays, both from `PinholeCamera.rays`. Their product with an error of the ray is, to first order,
the error in pixels of the distorted picture: lens and calibration cost nothing in the iterations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DAMPING_START = 1e-6  # of the normal matrix' diagonal
_DAMPING_END = 1e6  # no step of this length is an improvement: the minimum is reached
_MIN_DEPTH = 1e-6  # m; a point nearer to the camera's plane has no image


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


def rotation_from_vector(w: Array) -> Array:
    """Returns exp([w]x) of (..., 3) rotation vectors: (..., 3, 3) (Rodrigues)."""
    angle = np.sqrt((w * w).sum(axis=-1))[..., None, None]
    W = cross_matrix(w)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1 - np.cos(safe)) / (safe * safe))
    return np.eye(3) + a * W + b * (W @ W)


def cross_matrix(w: Array) -> Array:
    """Returns [w]x of (..., 3) vectors: (..., 3, 3)."""
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 2, 1] = w[..., 0]
    W[..., 0, 2] = w[..., 1]
    W[..., 1, 0] = w[..., 2]
    W[..., 1, 2] = -w[..., 0]
    W[..., 2, 0] = -w[..., 1]
    W[..., 0, 1] = -w[..., 2]
    return W


def squared_errors(R: Array, p: Array, points: Array, rays: Array, by_ray: Array) -> Array:
    """Returns the sum of squared residuals of each problem: (b,) px^2, inf behind the camera.

    Args:
        R: (b, 3, 3) `R_CF`.
        p: (b, 3) `p_CF`, m.
        points: (b, m, 3) or (m, 3), in F, m.
        rays: (b, m, 2) or (m, 2), measured.
        by_ray: (b, m, 2, 2) or (m, 2, 2) derivative of the pixels by the rays, px.
    """
    p_C = points @ R.swapaxes(-1, -2) + p[:, None, :]
    behind = (p_C[..., 2] < _MIN_DEPTH).any(axis=-1)
    if behind.any():
        p_C[behind] = (0.0, 0.0, 1.0)
    residual = by_ray @ (p_C[..., :2] / p_C[..., 2:] - rays)[..., None]
    error = (residual * residual).sum(axis=(-1, -2, -3))
    error[behind] = np.inf
    return error


def _normal_equations(
    R: Array, p: Array, points: Array, rays: Array, by_ray: Array
) -> tuple[Array, Array, Array]:
    """Returns the squared errors (b,), J'J (b, 6, 6) and J'r (b, 6) at the given poses."""
    arm = points @ R.swapaxes(-1, -2)  # R p_F
    p_C = arm + p[:, None, :]
    behind = (p_C[..., 2] < _MIN_DEPTH).any(axis=-1)
    if behind.any():
        p_C[behind] = (0.0, 0.0, 1.0)
    inverse_depth = 1 / p_C[..., 2]
    ray = p_C[..., :2] * inverse_depth[..., None]
    # Derivative of the ray (x/z, y/z) by position and, through p_C = w x arm + ..., by rotation.
    D = np.zeros((*ray.shape, 6))
    D[..., 0, 3] = D[..., 1, 4] = inverse_depth
    D[..., 5] = -ray * inverse_depth[..., None]
    gz = D[..., 5]
    ax, ay, az = arm[..., 0], arm[..., 1], arm[..., 2]
    D[..., 0] = ay[..., None] * gz
    D[..., 1] = -ax[..., None] * gz
    D[..., 1, 0] -= az * inverse_depth
    D[..., 0, 1] += az * inverse_depth
    D[..., 0, 2] = -ay * inverse_depth
    D[..., 1, 2] = ax * inverse_depth
    rows = 2 * points.shape[-2]
    J = (by_ray @ D).reshape(len(R), rows, 6)
    r = (by_ray @ (ray - rays)[..., None]).reshape(len(R), rows, 1)
    Jt = J.swapaxes(-1, -2)
    error = (r * r).sum(axis=(-1, -2))
    error[behind] = np.inf
    return error, Jt @ J, (Jt @ r)[..., 0]


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
        points: (b, m, 3) or (m, 3), in F, m.
        rays: (b, m, 2) or (m, 2), measured.
        by_ray: (b, m, 2, 2) or (m, 2, 2) derivative of the pixels by the rays, px.
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
    error, H, g = _normal_equations(R, p, points, rays, by_ray)
    R, p = R.copy(), p.copy()
    damping = np.full(len(R), _DAMPING_START)
    active = np.isfinite(error)
    diagonal = np.arange(6)
    for _ in range(iterations):
        damped = H.copy()
        damped[:, diagonal, diagonal] *= 1 + damping[:, None]
        if not active.all():
            damped[~active] = np.eye(6)
        step = np.asarray(-np.linalg.solve(damped, g[..., None])[..., 0], np.float64)
        # What the step would gain is known beforehand: the last look is spared.
        active &= -(step * g).sum(axis=1) >= tolerance * (1 + error)
        if not active.any():
            break
        R_new = rotation_from_vector(step[:, :3]) @ R
        p_new = p + step[:, 3:]
        error_new, H_new, g_new = _normal_equations(R_new, p_new, points, rays, by_ray)
        better = active & (error_new <= error)
        for old, new in ((R, R_new), (p, p_new), (error, error_new), (H, H_new), (g, g_new)):
            old[better] = new[better]
        damping *= np.where(better, 0.1, 10.0)
        active &= damping < _DAMPING_END
        best = int(np.argmin(error))
        if not active[best]:
            active &= error <= error[best] + hopeless
    return PnpSolution(R, p, error, H)


def covariance(information: Array, pixel_noise: float) -> Array:
    """Returns the covariance (b, 6, 6) of poses whose corners carry noise of `pixel_noise` (px).

    The Cramer-Rao bound at the solution: sigma^2 (J'J)^-1. A direction that the corners do not
    determine gets a huge variance, never NaN.
    """
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-9 * np.maximum(values[..., -1:], 1e-9))
    return pixel_noise**2 * (vectors / values[..., None, :]) @ vectors.swapaxes(-1, -2)
