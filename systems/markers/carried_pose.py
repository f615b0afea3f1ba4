"""Poses carried from a marker to its map and on to the body, with what they tell of each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.markers.pnp import normal_equations
from systems.small_matrices import congruence, multiply

Array = NDArray[np.float64]


@compiled("void(f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[:,::1])")
def pose_of_body(
    R_CW: Array,
    p_CW: Array,
    covariance: Array,
    R_CB: Array,
    p_CB: Array,
    R_WB: Array,
    p_WB: Array,
    carried: Array,
) -> None:
    """Writes X_WB and its covariance.

    Args:
        R_CW: (3, 3), nearly a rotation.
        p_CW: (3,) m.
        covariance: (6, 6) of X_CW: a small rotation vector, then the position, in C.
        R_CB: (3, 3) of the body in the camera.
        p_CB: (3,) m.
        R_WB: (3, 3) written.
        p_WB: (3,) written, m.
        carried: (6, 6) written: of X_WB, rotation first, in W.
    """
    # A Newton step toward the rotation next to a product of many, which rounding has bent.
    square, R_WC = np.empty((3, 3)), np.empty((3, 3))
    multiply(R_CW.T, R_CW, square)
    multiply(R_CW, square, R_WB)
    for i in range(3):
        for j in range(3):
            R_WC[j, i] = 1.5 * R_CW[i, j] - 0.5 * R_WB[i, j]
    multiply(R_WC, R_CB, R_WB)
    x, y, z = p_CB[0] - p_CW[0], p_CB[1] - p_CW[1], p_CB[2] - p_CW[2]
    # The body turns by -R_WC delta, about C; and moves by -R_WC (tau - (p_CB - p_CW) x delta).
    G = np.zeros((6, 6))
    for i in range(3):
        a, b, c = R_WC[i, 0], R_WC[i, 1], R_WC[i, 2]
        p_WB[i] = a * x + b * y + c * z
        G[i, 0], G[i, 1], G[i, 2] = -a, -b, -c
        G[3 + i, 3], G[3 + i, 4], G[3 + i, 5] = -a, -b, -c
        G[3 + i, 0], G[3 + i, 1], G[3 + i, 2] = b * z - c * y, c * x - a * z, a * y - b * x
    congruence(G, covariance, carried)


@compiled(
    "void(f8[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,:,::1],"
    " f8[:,:,::1], f8[:,::1], f8[:,:,::1])"
)
def poses_of_map(
    R_CM: Array,
    p_CM: Array,
    R_MW: Array,
    p_WM: Array,
    points: Array,
    rays: Array,
    by_ray: Array,
    R_CW: Array,
    p_CW: Array,
    product: Array,
) -> None:
    """Writes the poses of the map by b poses of one of its markers, and what the corners say there.

    Args:
        R_CM: (b or more, 3, 3) of the marker.
        p_CM: (b or more, 3) m.
        R_MW: (3, 3) of the map in the marker.
        p_WM: (3,) of the marker in the map, m.
        points: (m, 3) the marker's corners in W, m.
        rays: (m, 2) of the corners.
        by_ray: (m, 2, 2) derivative of the pixels by the rays.
        R_CW: (b, 3, 3) written.
        p_CW: (b, 3) written, m.
        product: (b, 7, 7) written, [J r]'[J r] (see `normal_equations`).
    """
    for k in range(len(R_CW)):
        multiply(R_CM[k], R_MW, R_CW[k])
        for i in range(3):
            x, y, z = R_CW[k, i]
            p_CW[k, i] = p_CM[k, i] - (x * p_WM[0] + y * p_WM[1] + z * p_WM[2])
        normal_equations(R_CW[k], p_CW[k], points, rays, by_ray, product[k])
