"""How much of each pixel lies inside polygons: exactly, out of their edges alone.

A region's share of every pixel is a sum over its edges (Green's theorem): an edge that runs right
by `d` adds `d` to all pixels below it in its column, and to the pixel that it crosses the part
below it. So each edge is cut at the pixels' borders, every piece leaves two numbers behind, and a
running sum down the columns makes the picture. Smooth font rasterisers count the same areas.

An edge carries a weight: by how much the picture grows from its left hand to its right, for one who
walks along it. (In a picture y runs down: the right hand of who walks to the right is below.) So a
patchwork is drawn by its edges, each once, with the step between its neighbours; and a lone
region by an outline that runs clockwise as seen, with the weight 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed

Array = NDArray[np.float64]
Picture = NDArray[np.float32]


class Box(NamedTuple):
    """A part of the picture, in whole pixels; `right` and `bottom` are the first beyond it."""

    left: int
    top: int
    right: int
    bottom: int

    @staticmethod
    def around(points: Array, width: int, height: int) -> Box:
        """Returns the smallest box with all pixels that points (..., 2) px are in or between."""
        flat = points.reshape(-1, 2)
        low, high = np.floor(flat.min(axis=0) + 0.5), np.floor(flat.max(axis=0) + 0.5) + 1
        size = [width, height]
        left, top = (int(v) for v in np.clip(low, 0, size))
        right, bottom = (int(v) for v in np.clip(high, 0, size))
        return Box(left, top, max(left, right), max(top, bottom))

    @property
    def empty(self) -> bool:
        """Whether there is no pixel in it."""
        return self.right <= self.left or self.bottom <= self.top


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges that bound what is to be drawn.

    Attributes:
        start: (n, 2) px, from the first pixel's centre.
        end: (n, 2) px.
        weight: (n,) growth from the left hand to the right.
    """

    start: Array
    end: Array
    weight: Array


def outlines(points: Array, weight: Array | float = 1.0) -> Edges:
    """Returns the edges of closed outlines of equally many corners.

    Args:
        points: (m, k, 2) px, clockwise as seen.
        weight: of each, (m,) or one number.
    """
    m, k, _ = points.shape
    weights = np.broadcast_to(np.asarray(weight, float).reshape(-1, 1), (m, k))
    end = np.concatenate([points[:, 1:], points[:, :1]], axis=1)
    return Edges(points.reshape(-1, 2), end.reshape(-1, 2), weights.ravel())


class CoverageSheet:
    """Measures coverage; keeps the memory for it, since fresh memory takes longer than the sums."""

    def __init__(self) -> None:
        self._memory = np.zeros(0, np.float32)

    def __call__(self, planes: Sequence[tuple[Edges, Box]]) -> list[Picture]:
        """Sums, for each plane, the weighted shares of the pixels of its box.

        Args:
            planes: edges, and the box that is wanted. What runs above a box counts in it, as it
                must; what runs beside or below it does not.

        Returns:
            (height, width) of each; valid until the next call.
        """
        sizes = [(box.bottom - box.top + 1) * (box.right - box.left) for _, box in planes]
        if self._memory.size < sum(sizes):
            self._memory = np.empty(sum(sizes), np.float32)
        pictures, used = [], 0
        for (edges, box), size in zip(planes, sizes, strict=True):
            height, width = box.bottom - box.top, box.right - box.left
            sums = self._memory[used : used + size].reshape(height + 1, width)
            used += size
            _sum_shares(
                packed(edges.start), packed(edges.end), packed(edges.weight),
                float(box.left), float(box.top), sums,
            )  # fmt: skip
            pictures.append(sums[:height])
        return pictures


@compiled("void(f8[:,::1], f8[:,::1], f8[::1], f8, f8, f4[:,::1])")
def _sum_shares(
    start: Array, end: Array, weight: Array, left: float, top: float, sums: Picture
) -> None:
    """Writes the shares of the pixels of a box, (height + 1, width); the last row is of no use.

    Args:
        start: (n, 2) px.
        end: (n, 2) px.
        weight: (n,).
        left: first column of the box, px.
        top: first row, px.
        sums: written.
    """
    height, width = len(sums) - 1, sums.shape[1]
    sums[:] = 0.0
    for n in range(len(weight)):
        xs, ys = start[n, 0] + 0.5 - left, start[n, 1] + 0.5 - top
        xe, ye = end[n, 0] + 0.5 - left, end[n, 1] + 0.5 - top
        run = xe - xs
        if not abs(run) >= 1e-9:  # px: it leaves nothing behind
            continue
        slope = (ye - ys) / run
        low, high = min(xs, xe), max(xs, xe)
        # Cut into columns: pieces [xa, xb] of the edge, as numbers without direction.
        for column in range(max(math.floor(low), 0), min(math.ceil(high), width)):
            xa, xb = max(low, float(column)), min(high, column + 1.0)
            amount = math.copysign(xb - xa, run) * weight[n]
            ya, yb = ys + slope * (xa - xs), ys + slope * (xb - xs)
            upper, lower = min(ya, yb), max(ya, yb)
            span = lower - upper
            # Cut into rows. All that lies above the box is one piece, in the row -1.
            begin = max(math.floor(upper), -1)
            for row in range(begin, min(max(math.ceil(lower), begin + 1), height)):
                share, depth = 1.0, 0.0  # of the piece, and how deep it lies in its pixel
                yb = min(lower, row + 1.0)
                ya = upper if row < 0 else max(upper, float(row))
                if span >= 1e-12:
                    share = (yb - ya) / span
                if row >= 0:
                    depth = 0.5 * (ya + yb) - row
                place = max(row, 0)
                below = amount * share * depth
                sums[place, column] += amount * share - below
                sums[place + 1, column] += below
    for row in range(1, height):
        for column in range(width):
            sums[row, column] += sums[row - 1, column]
