"""Where a robot is by one picture of two other robots, when nothing better is known.

A marker's height in the picture gives its distance, its place the bearing. Two of them whose places
are known give the pose: the rigid motion of the plane that fits best (Procrustes). It is good to
some centimetres, which is enough to begin a filter of bearings with.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap

Array = NDArray[np.float64]

_APART = 0.5  # m, of two markers that a heading is taken from
_NEAR = 0.5  # m: nearer than this it is not the height that errs
_MISFIT = 0.25  # m: a marker farther off is not where, or not what, it is believed to be


def marker_centre(rays: Array) -> float:
    """Returns x/z of a marker's centre: where the picture's diagonals cross; NaN if they do not.

    Args:
        rays: (4, 2) x/z, y/z of its corners.
    """
    a, b, c, d = rays.tolist()
    along, across = (c[0] - a[0], c[1] - a[1]), (d[0] - b[0], d[1] - b[1])
    crossed = along[0] * across[1] - along[1] * across[0]
    if crossed == 0:
        return math.nan
    share = ((b[0] - a[0]) * across[1] - (b[1] - a[1]) * across[0]) / crossed
    return float(a[0] + share * along[0])


def place_in_robot(rays: Array, size: float, *, rear: bool) -> Array:
    """Returns where an upright marker is, [forward, left] (2,) m of the robot; NaN if it is not.

    Args:
        rays: (4, 2) x/z, y/z of its corners.
        size: of its black square, m.
        rear: whether the camera looks backward.
    """
    height = float((rays[[3, 2], 1] - rays[[0, 1], 1]).mean())
    if not height > 0:
        return np.full(2, math.nan)
    depth = size / height
    sign = -1.0 if rear else 1.0
    return sign * depth * np.array([1.0, -marker_centre(rays)])


def pose_by_places(seen: Array, points: Array, faces: Array) -> Array | None:
    """Returns the pose (3,) of a robot that sees points which are known.

    Args:
        seen: (n, 2) where markers are in the robot's axes, m.
        points: (n, 2) where they are in the world, m.
        faces: (n,) directions that they face, rad in the world.

    Returns:
        None when they are fewer than two, too near to each other or contradict one another, or when
        one would be seen from behind, as it would be had two robots been taken for each other.
    """
    sound = np.isfinite(seen).all(axis=1)
    b, w = (p[sound] @ np.array([1.0, 1.0j]) for p in (seen, points))
    if len(w) < 2 or np.abs(w - w[0]).max() < _APART:
        return None
    # The error of a distance that a height tells grows with its square.
    weights = 1 / np.maximum(np.abs(b), _NEAR) ** 4
    b_mean, w_mean = (np.average(z, weights=weights) for z in (b, w))
    turn = np.vdot((b - b_mean) * weights, w - w_mean)
    turn /= max(abs(turn), 1e-12)
    place = w_mean - turn * b_mean
    normals = np.exp(1j * faces[sound])
    misfit = np.abs(place + turn * b - w).max()
    facing = ((place - w) * normals.conj()).real
    if misfit > _MISFIT or facing.min() <= 0:
        return None
    return np.array([place.real, place.imag, wrap(float(np.angle(turn)))])
