"""How noisy the corners of a marker are, by how small it looks: one model for all who need it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def narrow_side(corners: Array) -> Array:
    """Returns the narrow side of quadrilaterals (n, 4, 2) px: (n,) px.

    That is the smaller singular value of the affine map that takes the unit square to the corners
    best. A square seen straight on has its side; one that is tilted has its side times the cosine
    of the tilt, whichever way it is turned. Detectors fail by this number.
    """
    a, b, c, d = (corners[:, i] for i in range(4))
    right, down = (b - a + c - d) / 2, (d - a + c - b) / 2
    squares = (right * right + down * down).sum(axis=1) / 2
    difference = (right * right - down * down).sum(axis=1) / 2
    product = (right * down).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(squares - np.hypot(difference, product), 0.0)))


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
