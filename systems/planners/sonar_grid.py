"""A grid of what ultrasonic range finders heard, and what of it counts as an obstacle.

A range finder says how near something is, and hardly where: the echo came from anywhere on an arc
as wide as its cone, 0.26 of the range for a cone of 15 degrees. What it says for certain is that
nothing is nearer: the sector up to the echo is free. So the whole arc is taken for occupied, a
little at a time, and a reading that passes through a part of it takes that back, by more: what is
left of the arcs after robots have listened from several places is the obstacle.

Moravec and Elfes, "High resolution maps from wide angle sonar", ICRA 1985. They divide an echo
among the cells of its arc, by what is known of each; we weigh hits less than misses instead, which
needs no order among the readings of many robots. Neither holds for smooth walls that throw the
sound aside: those look free until they are met at a right angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from systems.messages import Message, OccupancyGrid
from systems.planners.occupancy import grown
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass
class SonarGridParameters:
    """How the grid is built, and what of it counts.

    Attributes:
        resolution: side of a cell, m.
        extent: [x_min, y_min, x_max, y_max] of the first grid, m; it grows as needed.
        growth: by how much it grows at least, m.
        max_side: longest side that it may grow to, m; scans that lead farther are dropped.
        hit: added to a cell that an arc passes through, in log-odds.
        miss: added to a cell in a free sector; by size above `hit`, so that a part of an arc that
            one robot hears and another hears through comes out free.
        least: lower bound of a cell.
        most: upper bound.
        occupied: from here on a cell is an obstacle,
        free: and down to here it stays one.
        margin: how far before an echo the free sector ends, besides half a cell, m: for the noise
            of ranges and poses.
        max_free_range: a cone without an echo is free no farther than this, m.
        max_echo_range: an echo from farther away is no obstacle yet, m: its arc is so wide that it
            would close ways that are free, and until a robot is nearer there is time to listen.
        max_shapes: that obstacles may be made of; where more would be needed, they are drawn with
            larger cells.
    """

    resolution: float = 0.1
    extent: list[float] = field(default_factory=lambda: [-4.0, -4.0, 8.0, 4.0])
    growth: float = 2.0
    max_side: float = 100.0
    hit: float = 0.45
    miss: float = -0.85
    least: float = -1.7
    most: float = 2.0
    occupied: float = 0.8
    free: float = 0.0
    margin: float = 0.03
    max_free_range: float = 4.0
    max_echo_range: float = 1.6
    max_shapes: int = 250

    def __post_init__(self) -> None:
        require_positive(
            resolution=self.resolution,
            growth=self.growth,
            max_side=self.max_side,
            hit=self.hit,
            most=self.most,
            max_free_range=self.max_free_range,
            max_echo_range=self.max_echo_range,
        )
        require_non_negative(margin=self.margin)
        for name, bound in (("miss", -self.hit), ("least", 0.0)):
            value = getattr(self, name)
            require(math.isfinite(value) and value < bound, name, value, f"less than {bound:g}")
        require(self.least < self.free, "free", self.free, f"above least, {self.least:g}")
        sound = self.free <= self.occupied < self.most
        require(
            sound, "occupied", self.occupied, f"from free, {self.free:g}, to most, {self.most:g}"
        )
        require(self.max_shapes >= 1, "max_shapes", self.max_shapes, "1 or greater")
        e = self.extent
        sound = len(e) == 4 and bool(np.isfinite(e).all()) and e[0] < e[2] and e[1] < e[3]
        sound = sound and max(e[2] - e[0], e[3] - e[1]) <= self.max_side
        require(
            sound, "extent", e, f"[x_min, y_min, x_max, y_max] of at most {self.max_side:g} m (m)"
        )


@dataclass(frozen=True, eq=False)
class SonarGrid(Message):
    """What is known of the ground.

    Attributes:
        grid: log-odds.
        occupied: of the same shape: which cells count as obstacles.
    """

    grid: OccupancyGrid
    occupied: Mask


@dataclass(frozen=True, eq=False)
class Cones:
    """One reading of range finders in the plane.

    Attributes:
        faces: (n, 2) where they are, m.
        directions: (n,) of their axes, rad.
        half_angles: (n,) from the axis to the edge, rad; pi for a disc.
        free: (n,) how far nothing is, m; 0 or less says nothing.
        echoes: (n,) range of an echo that counts, m; NaN for none.
    """

    faces: Array
    directions: Array
    half_angles: Array
    free: Array
    echoes: Array


def empty_sonar_grid(parameters: SonarGridParameters, frame_id: str = "map") -> SonarGrid:
    """Returns the first grid: nothing is known."""
    x_min, y_min, x_max, y_max = parameters.extent
    rows = math.ceil((y_max - y_min) / parameters.resolution - 1e-9)
    columns = math.ceil((x_max - x_min) / parameters.resolution - 1e-9)
    grid = OccupancyGrid(
        frame_id=frame_id,
        resolution=parameters.resolution,
        origin=np.array([x_min, y_min]),
        log_odds=np.zeros((rows, columns), np.float32),
    )
    return SonarGrid(grid, np.zeros((rows, columns), bool))


def with_cones(
    known: SonarGrid, cones: Cones, stamp: float, parameters: SonarGridParameters
) -> SonarGrid:
    """Returns the grid after one reading: each cell is changed by it at most once.

    A cell is free when its middle is in a free sector. It is hit when its middle is on the arc of
    an echo, up to half a cell, and not free.

    Args:
        known: before.
        cones: the reading.
        stamp: of it, s.
        parameters: weights.

    Raises:
        ValueError: the grid would have to be larger than allowed.
    """
    p = parameters
    reach = np.fmax(cones.free, cones.echoes + p.resolution)
    far = float(np.max(reach, initial=0.0))
    if far <= 0:
        return known
    corners = np.concatenate([cones.faces - far, cones.faces + far])
    known = _grown(known, corners, p)
    grid = known.grid
    low = np.floor((corners.min(axis=0) - grid.origin) / grid.resolution).astype(np.intp)
    high = np.floor((corners.max(axis=0) - grid.origin) / grid.resolution).astype(np.intp)
    window = np.s_[low[1] : high[1] + 1, low[0] : high[0] + 1]
    x, y = (
        grid.origin[axis] + (np.arange(low[axis], high[axis] + 1) + 0.5) * grid.resolution
        for axis in (0, 1)
    )
    free = np.zeros((len(y), len(x)), bool)
    hit = np.zeros_like(free)
    half = grid.resolution / 2
    parts = (cones.faces, cones.directions, np.cos(cones.half_angles), cones.free, cones.echoes)
    for face, direction, least_cosine, clear, echo in zip(*parts, strict=True):
        dx, dy = x - face[0], (y - face[1])[:, None]
        away = np.sqrt(dx * dx + dy * dy)
        inside = dx * math.cos(direction) + dy * math.sin(direction) >= least_cosine * away
        free |= inside & (away <= clear)
        if not math.isnan(echo):
            hit |= inside & (away >= echo - half) & (away < echo + half)
    change = np.where(free, p.miss, np.where(hit, p.hit, 0.0))
    return _changed(known, window, change, stamp, p)


def _changed(
    known: SonarGrid,
    window: tuple[slice, slice],
    change: Array,
    stamp: float,
    p: SonarGridParameters,
) -> SonarGrid:
    log_odds = known.grid.log_odds.copy()
    log_odds[window] = np.clip(log_odds[window] + change, p.least, p.most)
    part = log_odds[window]
    now = (part >= p.occupied) | (known.occupied[window] & (part > p.free))
    occupied = known.occupied
    if not np.array_equal(now, occupied[window]):
        occupied = occupied.copy()
        occupied[window] = now
    return SonarGrid(replace(known.grid, stamp=stamp, log_odds=log_odds), occupied)


def _grown(known: SonarGrid, points: Array, p: SonarGridParameters) -> SonarGrid:
    grid = grown(known.grid, points, growth=p.growth, max_side=p.max_side)
    if grid is known.grid:
        return known
    column, row = np.rint((known.grid.origin - grid.origin) / grid.resolution).astype(np.intp)
    occupied = np.zeros(grid.log_odds.shape, bool)
    rows, columns = known.occupied.shape
    occupied[row : row + rows, column : column + columns] = known.occupied
    return SonarGrid(grid, occupied)


def rectangles(known: SonarGrid, max_shapes: int) -> Array:
    """Returns rectangles that cover exactly the occupied cells, (m, 4, 2) m, counterclockwise.

    Args:
        known: the grid.
        max_shapes: where more would be needed, cells are taken together by two and two, as often
            as it takes; one that is partly occupied counts as a whole.
    """
    occupied, cell = known.occupied, known.grid.resolution
    while len(found := _rectangles(occupied)) > max_shapes:
        rows, columns = (side + side % 2 for side in occupied.shape)
        padded = np.zeros((rows, columns), bool)
        padded[: occupied.shape[0], : occupied.shape[1]] = occupied
        occupied = np.asarray(padded.reshape(rows // 2, 2, columns // 2, 2).any(axis=(1, 3)))
        cell *= 2
    boxes = np.array(found, float).reshape(-1, 4)  # row, column, and those after the last
    y0, x0, y1, x1 = boxes.T
    corners = np.stack([np.stack(xy, axis=-1) for xy in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])
    return np.asarray(known.grid.origin + cell * corners.transpose(1, 0, 2))


def _rectangles(occupied: Mask) -> list[tuple[int, int, int, int]]:
    """Returns the runs of cells in each row, with equal runs of rows that follow put together."""
    edges = np.diff(np.pad(occupied, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, begins = np.nonzero(edges == 1)
    ends = np.nonzero(edges == -1)[1]
    done: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], tuple[int, int]] = {}  # columns to first row and row after last
    for row, begin, end in zip(rows.tolist(), begins.tolist(), ends.tolist(), strict=True):
        first, after = growing.get((begin, end), (row, row))
        if after != row:
            done.append((first, begin, after, end))
            first = row
        growing[begin, end] = first, row + 1
    done += [(first, begin, after, end) for (begin, end), (first, after) in growing.items()]
    return sorted(done)
