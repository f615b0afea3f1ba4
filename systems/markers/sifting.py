"""Which markers of a picture serve to be located by, and the largest first."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, in_rows

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SIFTED = ("unknown_id", "repeated_id", "bad_corners", "too_small")


def sift(known: Index, corners: Array, min_side: float) -> tuple[Index, dict[str, int]]:
    """Returns the markers that serve, by their area in the picture from the largest on.

    Args:
        known: (n,) which of the known markers each is; -1 for none of them.
        corners: (n, 4, 2) px.
        min_side: markers whose shortest side is shorter are left out, px.

    Returns:
        (m,) which of the n, and reason (one of `SIFTED`) to number of those left out for it; a
        marker counts for the first reason that holds. Of two of one id none serves: which is the
        real one cannot be told.
    """
    order, dropped = np.empty(len(known), np.intp), np.zeros(len(SIFTED), np.intp)
    m = _sift(known, in_rows(corners, 4, 2), min_side, order, dropped)
    return order[:m], dict(zip(SIFTED, dropped.tolist(), strict=True))


@compiled("i8(i8[::1], f8[:,:,::1], f8, i8[::1], i8[::1])")
def _sift(known: Index, corners: Array, min_side: float, order: Index, dropped: Index) -> int:
    """Writes what `sift` returns, and returns how many serve."""
    m = 0
    areas = np.empty(len(known))
    for n in range(len(known)):
        if known[n] < 0:
            dropped[0] += 1
            continue
        repeated = False
        for k in range(len(known)):
            repeated |= k != n and known[k] == known[n]
        if repeated:
            dropped[1] += 1
            continue
        square = math.inf
        for i in range(4):
            x = corners[n, i, 0] - corners[n, i - 1, 0]
            y = corners[n, i, 1] - corners[n, i - 1, 1]
            square = min(square, x * x + y * y)
            if not (math.isfinite(corners[n, i, 0]) and math.isfinite(corners[n, i, 1])):
                square = math.nan
                break
        if math.isnan(square):
            dropped[2] += 1
            continue
        if square < min_side * min_side:
            dropped[3] += 1
            continue
        # Half the cross product of the diagonals.
        px, py = corners[n, 2, 0] - corners[n, 0, 0], corners[n, 2, 1] - corners[n, 0, 1]
        qx, qy = corners[n, 3, 0] - corners[n, 1, 0], corners[n, 3, 1] - corners[n, 1, 1]
        areas[n] = abs(px * qy - py * qx) / 2
        place = m
        while place > 0 and areas[order[place - 1]] < areas[n]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = n
        m += 1
    return m
