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


def _keep_before_camera(p_C: Array) -> NDArray[np.bool_]:
    """Returns which problems (...) have one of their points (..., m, 3) behind the camera.

    Their points are moved to where computing with them does no harm.
    """
    behind = np.asarray((p_C[..., 2] < _MIN_DEPTH).any(axis=-1))
    if behind.any():
        p_C[behind] = (0.0, 0.0, 1.0)
    return behind


def _normal_equations(R: Array, p: Array, points: Array, rays: Array, by_ray: Array) -> Array:
    """Returns [J r]'[J r], (b, 7, 7), at the given poses: J'J, J'r and the squared error r'r.

    Of a problem with a point behind the camera the error is infinite.
    """
    arm = points @ R.swapaxes(-1, -2)  # R p_F
    p_C = arm + p[:, None, :]
    behind = _keep_before_camera(p_C)
    depth = p_C[..., 2:]
    ray = p_C[..., :2] / depth
    # Derivative of the ray (x/z, y/z) by position and, through p_C = w x arm + ..., by rotation.
    by_position = np.empty((*ray.shape, 3))
    by_position[..., :2] = by_ray
    by_position[..., 2:] = by_ray @ -ray[..., None]
    by_position /= depth[..., None]
    rows = np.empty((*ray.shape, 7))
    rows[..., :3] = by_position @ cross_matrix(-arm)
    rows[..., 3:6] = by_position
    rows[..., 6:] = by_ray @ (ray - rays)[..., None]
    rows = rows.reshape(len(R), 2 * points.shape[-2], 7)
    product = np.asarray(rows.swapaxes(-1, -2) @ rows)
    product[behind, 6, 6] = np.inf
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
    R, p = R.copy(), p.copy()
    product = _normal_equations(R, p, points, rays, by_ray)
    H, g, error = product[:, :6, :6], product[:, :6, 6:], product[:, 6, 6]  # views
    damping = np.full(len(R), _DAMPING_START)
    active = np.isfinite(error)
    identity = np.eye(6)
    for _ in range(iterations):
        damped = H * (1 + damping[:, None, None] * identity)
        if not active.all():
            damped[~active] = identity
        step = np.asarray(np.linalg.solve(damped, -g), np.float64)
        # What the step would gain is known beforehand: the last look is spared.
        active &= -(step * g).sum(axis=(1, 2)) >= tolerance * (1 + error)
        if not active.any():
            break
        step = step[..., 0]
        R_new = rotation_from_vector(step[:, :3]) @ R
        p_new = p + step[:, 3:]
        product_new = _normal_equations(R_new, p_new, points, rays, by_ray)
        better = active & (product_new[:, 6, 6] <= error)
        for old, new in ((R, R_new), (p, p_new), (product, product_new)):
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
