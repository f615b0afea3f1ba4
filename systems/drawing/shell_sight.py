"""Which outlines on a sphere a camera sees, and where: compiled, as there are thousands of them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.drawing.layers import NEAREST
from systems.plumb_bob import distort

Array = NDArray[np.float64]

_HORIZON = 0.02  # cosine: an outline nearer to the horizon than this is left out


@compiled(
    "void(f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8, f8, f8[:,::1], f8[::1], f8, f8, f8,"
    " b1[::1])"
)
def find_visible(
    places: Array,
    reach: Array,
    eye: Array,
    R: Array,
    centre: Array,
    horizon: float,
    radius: float,
    K: Array,
    D: Array,
    width: float,
    height: float,
    slack: float,
    visible: NDArray[np.bool_],
) -> None:
    """Writes whether what reaches around unit vectors (n, 3) may be in the picture.

    Args:
        places: in the shell's frame, as `eye`.
        reach: (n,) rad, or (1,) for all.
        eye: (3,) where the camera is, m.
        R: (3, 3) of the shell in the optical frame.
        centre: (3,) of the shell there, m.
        horizon: cosine of its angle, as seen from the shell's centre.
        radius: of the shell, m.
        K: (3, 3) px.
        D: (5,).
        width: px.
        height: px.
        slack: how much larger than without a lens something may look.
        visible: (n,), written.
    """
    far = math.sqrt(eye[0] * eye[0] + eye[1] * eye[1] + eye[2] * eye[2])
    focal = max(K[0, 0], K[1, 1])
    p = np.empty(3)
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        visible[n] = False
        if not x * eye[0] + y * eye[1] + z * eye[2] > horizon * far:
            continue
        for i in range(3):
            p[i] = radius * (R[i, 0] * x + R[i, 1] * y + R[i, 2] * z) + centre[i]
        if not p[2] > NEAREST:
            continue
        u, v, _, _, _ = distort(p[0] / p[2], p[1] / p[2], D)
        u, v = K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]
        more = slack * reach[n % len(reach)] * radius * focal / p[2]
        visible[n] = -more < u < width + more and -more < v < height + more


@compiled(
    "void(f8[:,:,::1], f8[::1], f8[:,::1], f8[::1], f8, f8[:,::1], f8[::1], f8, f8[:,:,::1],"
    " b1[::1])"
)
def project_outlines(
    corners: Array,
    eye: Array,
    R: Array,
    centre: Array,
    radius: float,
    K: Array,
    D: Array,
    fold_radius: float,
    places: Array,
    good: NDArray[np.bool_],
) -> None:
    """Writes where corners (m, k, 3) m are seen, (m, k, 2) px, and which outlines are wholly (m,).

    For the other arguments see `find_visible`; `fold_radius` is the camera's.
    """
    for m in range(len(corners)):
        good[m] = True
        for k in range(corners.shape[1]):
            # The angle between the sphere's normal and the line of sight, as far as it shrinks
            # areas.
            facing, square, x, y, z = 0.0, 0.0, centre[0], centre[1], centre[2]
            for i in range(3):
                corner = corners[m, k, i]
                toward = eye[i] - corner
                facing += toward * corner
                square += toward * toward
                x += R[0, i] * corner
                y += R[1, i] * corner
                z += R[2, i] * corner
            ahead = facing > _HORIZON * radius * math.sqrt(square) and z > NEAREST
            if not ahead or math.hypot(x, y) > 0.98 * fold_radius * z:
                good[m] = False
                break
            u, v, _, _, _ = distort(x / z, y / z, D)
            places[m, k, 0], places[m, k, 1] = K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]
