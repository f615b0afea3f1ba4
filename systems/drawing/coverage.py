"""How much of each pixel lies inside polygons: exactly, out of their edges alone.

A region's share of every pixel is a sum over its edges (Green's theorem): an edge that runs right
by `d` adds `d` to all pixels below it in its column, and to the pixel that it crosses the part
below it. So each edge is cut at the pixels' borders, every piece leaves two numbers behind, and a
running sum down the columns makes the picture. Smooth font rasterisers count the same areas, one
outline after the other; here all edges of all outlines are cut together.

An edge carries a weight: by how much the picture grows from its left hand to its right, for one who
walks along it. (In a picture y runs down: the right hand of who walks to the right is below.) So a
patchwork is drawn by its edges, each once, with the step between its neighbours; and a lone
region by an outline that runs clockwise as seen, with the weight 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.float32]
Index = NDArray[np.intp]


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
        # The boxes lie side by side in one sheet, so that all edges go through each step together.
        widths = np.array([box.right - box.left for _, box in planes], int)
        heights = np.array([box.bottom - box.top for _, box in planes], int)
        places = np.cumsum(widths) - widths
        width, height = int(widths.sum()), int(heights.max(initial=0))
        if width == 0 or height == 0:
            return [np.zeros((h, w), np.float32) for h, w in zip(heights, widths, strict=True)]
        counts = [len(edges.weight) for edges, _ in planes]
        corner = np.array([[box.left, box.top] for _, box in planes]).reshape(-1, 2)
        shift = 0.5 - corner + np.stack([places, np.zeros_like(places)], axis=1)
        start = np.concatenate([e.start + s for (e, _), s in zip(planes, shift, strict=True)]).T
        end = np.concatenate([e.end + s for (e, _), s in zip(planes, shift, strict=True)]).T
        weight = np.concatenate([edges.weight for edges, _ in planes])
        first, after = np.repeat(places, counts), np.repeat(places + widths, counts)

        # Cut into columns: pieces [xa, xb] of edges, as numbers without direction.
        (xs, ys), (xe, ye) = start, end
        low, high = np.minimum(xs, xe), np.maximum(xs, xe)
        edge, column = _cells(low, high, first, after)
        xa, xb = np.maximum(low.take(edge), column), np.minimum(high.take(edge), column + 1)
        run = xe - xs
        steep = np.abs(run) < 1e-9  # px: it leaves nothing behind
        slope = (ye - ys) / np.where(steep, np.inf, run)
        amount = (xb - xa) * (np.sign(run) * weight).take(edge)
        slope, xs, ys = slope.take(edge), xs.take(edge), ys.take(edge)
        ya, yb = ys + slope * (xa - xs), ys + slope * (xb - xs)

        # Cut into rows. All that lies above the box is one piece, in the row -1.
        low, high = np.minimum(ya, yb), np.maximum(ya, yb)
        piece, row = _cells(np.maximum(low, -0.5), np.maximum(high, -0.5), -1, height)
        low, high = low.take(piece), high.take(piece)
        above = row < 0
        ya, yb = np.where(above, low, np.maximum(low, row)), np.minimum(high, row + 1)
        span = high - low
        flat = span < 1e-12
        share = np.where(flat, 1.0, (yb - ya) / np.where(flat, 1.0, span))
        part = amount.take(piece) * share
        depth = np.where(above, 0.0, 0.5 * (ya + yb) - row)  # of the piece in its pixel
        place = np.maximum(row, 0) * width + column.take(piece)
        below = part * depth
        size = (height + 1) * width
        if self._memory.size < size:
            self._memory = np.empty(size, np.float32)
        sums = self._memory[:size]
        sums.fill(0.0)
        np.add.at(sums, place, (part - below).astype(np.float32))
        np.add.at(sums, place + width, below.astype(np.float32))
        sheet = sums.reshape(height + 1, width)
        previous = sheet[0]
        for line in sheet[1:]:  # five times as fast as cumsum along the columns
            line += previous
            previous = line
        return [sheet[:h, x : x + w] for h, w, x in zip(heights, widths, places, strict=True)]


def _cells(
    low: Array, high: Array, first: Index | int, after: Index | int
) -> tuple[Index, NDArray[np.intp]]:
    """Returns which unit cells each interval reaches into, between `first` and `after`.

    Returns:
        (m,) index of the interval, and (m,) number of the cell.
    """
    floor = np.floor(low)
    begin = np.minimum(np.maximum(floor, first), after).astype(np.intp)
    end = np.minimum(np.maximum(np.ceil(high), floor + 1), after).astype(np.intp)
    counts = np.maximum(end - begin, 0)
    interval = np.repeat(np.arange(len(counts)), counts)
    offset = begin - (np.cumsum(counts) - counts)
    return interval, offset.take(interval) + np.arange(len(interval))
