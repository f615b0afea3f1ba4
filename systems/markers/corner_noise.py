"""How noisy the corners of a marker are, by how small it looks: one model for all who need it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, in_rows

Array = NDArray[np.float64]


def narrow_side(corners: Array) -> Array:
    """Returns the narrow side of quadrilaterals (n, 4, 2) px: (n,) px.

    That is the smaller singular value of the affine map that takes the unit square to the corners
    best. A square seen straight on has its side; one that is tilted has its side times the cosine
    of the tilt, whichever way it is turned. Detectors fail by this number.
    """
    corners = in_rows(corners, 4, 2)
    sides = np.empty(len(corners))
    _narrow_sides(corners, sides)
    return sides


@compiled("void(f8[:,:,::1], f8[::1])")
def _narrow_sides(corners: Array, sides: Array) -> None:
    for k in range(len(corners)):
        sides[k] = narrow_side_of(corners[k])


@compiled()
def narrow_side_of(corners: Array) -> float:
    """Returns the narrow side of one quadrilateral (4, 2); for compiled code."""
    squares, difference, product = 0.0, 0.0, 0.0
    for i in range(2):
        a, b, c, d = corners[0, i], corners[1, i], corners[2, i], corners[3, i]
        right, down = (b - a + c - d) / 2, (d - a + c - b) / 2
        squares += (right * right + down * down) / 2
        difference += (right * right - down * down) / 2
        product += right * down
    return math.sqrt(max(squares - math.hypot(difference, product), 0.0))


def corner_deviation(corners: Array, pixel_noise: float, pixel_noise_by_side: float) -> Array:
    """Returns the standard deviation of the corners' coordinates: (n,) px.

    The shorter an edge, the fewer pixels there are to fit its line to, so the noise falls with the
    narrow side s: sqrt(pixel_noise^2 + (pixel_noise_by_side / s)^2).

    Args:
        corners: (n, 4, 2) px.
        pixel_noise: of a large marker, px.
        pixel_noise_by_side: times the narrow side, of a small one, px^2.
    """
    if pixel_noise_by_side == 0:
        return np.full(len(corners), float(pixel_noise))
    return np.hypot(pixel_noise, pixel_noise_by_side / np.maximum(narrow_side(corners), 1.0))
