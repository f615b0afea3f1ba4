"""Plumb-bob (Brown-Conrady) distortion and its inverse, compiled.

Coefficients D (5,) are k1, k2, p1, p2, k3, as OpenCV and ROS (`plumb_bob`) order them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled

Array = NDArray[np.float64]


@compiled()
def distort(x: float, y: float, D: Array) -> tuple[float, float, float, float, float]:
    """Returns the distorted point and its derivative: of x by x, of y by y, and crosswise."""
    k1, k2, p1, p2, k3 = D[0], D[1], D[2], D[3], D[4]
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial = slope (x dx + y dy)
    return (
        x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx),
        y * radial + 2 * p2 * xy + p1 * (r2 + 2 * yy),
        radial + slope * xx + 2 * p1 * y + 6 * p2 * x,
        radial + slope * yy + 2 * p2 * x + 6 * p1 * y,
        slope * xy + 2 * (p1 * x + p2 * y),
    )


@compiled("void(f8[:,::1], f8[::1], f8[:,::1], f8[:,:,::1])")
def distort_all(points: Array, D: Array, distorted: Array, jacobian: Array) -> None:
    """Writes the distorted points (n, 2) of points (n, 2), and the derivative (n, 2, 2)."""
    for k in range(len(points)):
        x, y, by_x, by_y, across = distort(points[k, 0], points[k, 1], D)
        distorted[k, 0], distorted[k, 1] = x, y
        jacobian[k, 0, 0], jacobian[k, 0, 1] = by_x, across
        jacobian[k, 1, 0], jacobian[k, 1, 1] = across, by_y


@compiled("void(f8[:,::1], f8[:,::1], f8[::1], f8, f8[:,::1], f8[:,:,::1])")
def find_rays(
    pixels: Array, K: Array, D: Array, fold_radius: float, rays: Array, by_ray: Array
) -> None:
    """Writes the rays (n, 2) of pixels (n, 2) and the derivative (n, 2, 2) of the pixels by them.

    OpenCV's undistortPoints stops after five fixed-point steps; Newton's steps end at rounding
    error, and what does not converge is marked (NaN) instead of returned.

    Args:
        pixels: of the distorted picture, px.
        K: (3, 3) camera matrix, px.
        D: (5,) coefficients.
        fold_radius: how far from the axis the model holds (`PinholeCamera.fold_radius`).
        rays: written.
        by_ray: written, px.
    """
    fx, fy = K[0, 0], K[1, 1]
    for k in range(len(pixels)):
        x_seen, y_seen = (pixels[k, 0] - K[0, 2]) / fx, (pixels[k, 1] - K[1, 2]) / fy
        x, y, error = x_seen, y_seen, math.inf
        by_x, by_y, across = 1.0, 1.0, 0.0
        for _ in range(20):
            x_now, y_now, by_x, by_y, across = distort(x, y, D)
            ex, ey = x_seen - x_now, y_seen - y_now
            error = max(abs(ex), abs(ey))
            determinant = by_x * by_y - across * across
            x += (by_y * ex - across * ey) / determinant
            y += (by_x * ey - across * ex) / determinant
            if error < 1e-13:  # the derivative is as exact; the step leaves its square
                break
        # Beyond the fold the same pixel has other rays too, some on the far side of the axis.
        if error < 1e-6 and math.hypot(x, y) < fold_radius:
            rays[k, 0], rays[k, 1] = x, y
        else:
            rays[k, 0], rays[k, 1] = math.nan, math.nan
        by_ray[k, 0, 0], by_ray[k, 0, 1] = fx * by_x, fx * across
        by_ray[k, 1, 0], by_ray[k, 1, 1] = fy * across, fy * by_y


@compiled("void(f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,:,::1])")
def project_all(points: Array, K: Array, D: Array, pixels: Array, jacobian: Array) -> None:
    """Writes the pixels (n, 2) of points (n, 3) and their derivative (n, 2, 3) by the points.

    Args:
        points: in the optical frame, z > 0, m.
        K: (3, 3) camera matrix, px.
        D: (5,) coefficients.
        pixels: written, px.
        jacobian: written, px/m.
    """
    fx, fy = K[0, 0], K[1, 1]
    for k in range(len(points)):
        inverse = 1 / points[k, 2]
        x, y = points[k, 0] * inverse, points[k, 1] * inverse
        bent_x, bent_y, by_x, by_y, across = distort(x, y, D)
        pixels[k, 0], pixels[k, 1] = fx * bent_x + K[0, 2], fy * bent_y + K[1, 2]
        jacobian[k, 0, 0], jacobian[k, 0, 1] = fx * by_x * inverse, fx * across * inverse
        jacobian[k, 1, 0], jacobian[k, 1, 1] = fy * across * inverse, fy * by_y * inverse
        jacobian[k, 0, 2] = -fx * (by_x * x + across * y) * inverse
        jacobian[k, 1, 2] = -fy * (across * x + by_y * y) * inverse
