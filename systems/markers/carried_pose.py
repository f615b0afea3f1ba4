"""The pose of a body, with its covariance, from that of what its camera sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
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
