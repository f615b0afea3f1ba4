"""The moves by which a formation walks over an ideal lattice of equilateral triangles.

In open space and without errors, the closest-vertex rule of [FORM] says which robot goes where next
from nothing but where the formation stands: the robot farthest from the destination moves to the
free vertex nearest it. So the whole sequence is known beforehand, and a model of its errors can be
evaluated for thousands of runs at once.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from systems.validation import require, require_positive

Array = NDArray[np.float64]
Point = tuple[float, float]  # m
Cell = tuple[int, int]  # coordinates along two edges of the lattice that are 60 degrees apart

SIDE = 1.5  # m, [FORM]
LEAST_ROBOTS = 4  # three stand, one moves

_AROUND: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))  # anticlockwise
_HEIGHT = math.sqrt(3) / 2  # of a triangle, sides
_REACH = round(1 / math.sqrt(3), 9)  # sides


@dataclass(frozen=True)
class VertexWalk:
    """A sequence of m moves of n robots, and where each would be without errors.

    Attributes:
        side: of the triangles, m.
        start: (n, 2) m, where the robots stand before the first move.
        movers: (m,) the robot that moves.
        beacons: (m, 3) the robots it builds its triangle on: the one on its left, the one on its
            right, and the anchor behind it, which it sees in the middle of its rear camera.
        vertices: (m, 2) m, where it stands after the move.
        neighbours: of each move, the robots one side away from the new vertex.
        drives: (m,) m, length of the way of Algorithm II: from the mover to the centre between
            two beacons that is nearest it, to the one that is nearest the new vertex, and there.
    """

    side: float
    start: Array
    movers: NDArray[np.int64]
    beacons: NDArray[np.int64]
    vertices: Array
    neighbours: tuple[NDArray[np.int64], ...]
    drives: Array

    def __len__(self) -> int:
        """Returns the number of moves."""
        return len(self.movers)

    def axes(self) -> Array:
        """Returns (m, 2, 2): rows are the movers' left and forward in W, as they build."""
        anchors = np.empty((len(self), 2))
        at = self.start.copy()
        for k, (mover, beacons) in enumerate(zip(self.movers, self.beacons, strict=True)):
            anchors[k] = at[beacons[2]]
            at[mover] = self.vertices[k]
        return left_and_forward(self.vertices - anchors)

    def times(self, *, speed: float, build_speed: float = 0.1, build_way: float = 0.32) -> Array:
        """Returns (m,) s, when each move has ended, one after another from 0.

        Args:
            speed: of the drive, m/s.
            build_speed: while the triangle is built, m/s.
            build_way: driven while it is built, m. All three beacons are in the picture (640 px,
                f = 485 px, side 1.5 m) only from about 0.16 m short of the vertex on: the robot
                overshoots by as much and backs in. That is by angle, so it grows with the side:
                the value given is that of 1.5 m.
        """
        require_positive(speed=speed, build_speed=build_speed, build_way=build_way)
        building = build_way * self.side / SIDE / build_speed
        return np.cumsum(self.drives / speed + building)


def left_and_forward(away: Array) -> Array:
    """Returns (..., 2, 2): rows left and forward of robots that head along `away` (..., 2) m."""
    forward = away / np.linalg.norm(away, axis=-1, keepdims=True)
    left = np.stack([-forward[..., 1], forward[..., 0]], axis=-1)
    return np.stack([left, forward], axis=-2)


def closest_vertex_walk(
    waypoints: ArrayLike, *, robots: int = LEAST_ROBOTS, side: float = SIDE
) -> VertexWalk:
    """Returns the moves that lead a formation past waypoints by the closest-vertex rule.

    The robots start as those of [FORM] do: (0.75, 0), (0, 1.30), (2.25, 0), (1.5, 1.30) m for a
    side of 1.5 m, more of them in the same two rows behind. Of the robots that can leave (the
    others still stand in triangles joined by their edges) the farthest from the waypoint moves, to
    the free vertex nearest it that some triangle of the others points at; of robots equally far the
    first, of vertices equally near the one nearest the mover. A waypoint is passed when
    the robot that moved last stands within side / sqrt(3) of it, the radius of a triangle: nearer
    no vertex need be. That is ours.

    Args:
        waypoints: (k, 2) m.
        robots: how many, at least 4.
        side: of the triangles, m.

    Raises:
        ValueError: an argument is out of range, or the rule leads in a circle before a waypoint.
    """
    points = np.asarray(waypoints, float)
    shaped = points.ndim == 2 and points.shape[1] == 2 and bool(np.isfinite(points).all())
    require(shaped, "waypoints", waypoints, "points [x, y] of finite numbers, m")
    require(robots >= LEAST_ROBOTS, "robots", robots, f"{LEAST_ROBOTS} or more")
    require_positive(side=side)
    cells = start_cells(robots)
    start = np.array([_position(cell, side) for cell in cells])
    movers, beacons, vertices, neighbours, drives = [], [], [], [], []
    for point in points.tolist():
        been = set()
        last: Cell | None = None
        while last is None or _distance(last, point, side) > _REACH:
            formation = frozenset(cells)
            found = None if formation in been else _next_move(cells, point, side)
            if found is None:
                raise ValueError(
                    f"the closest-vertex rule of {robots} robots never reaches the waypoint "
                    f"({point[0]:g}, {point[1]:g}) m: choose another waypoint"
                )
            been.add(formation)
            mover, target, on = found
            others = [cell for k, cell in enumerate(cells) if k != mover]
            around = {_add(target, step) for step in _AROUND}
            movers.append(mover)
            beacons.append([cells.index(cell) for cell in on])
            vertices.append(_position(target, side))
            drives.append(_drive_length(cells[mover], target, others, side))
            neighbours.append(
                np.array([k for k, cell in enumerate(cells) if cell in around and k != mover])
            )
            cells[mover] = last = target
    return VertexWalk(
        side=side,
        start=start,
        movers=np.array(movers, np.int64),
        beacons=np.array(beacons, np.int64).reshape(-1, 3),
        vertices=np.array(vertices).reshape(-1, 2),
        neighbours=tuple(neighbours),
        drives=np.array(drives),
    )


def start_cells(robots: int) -> list[Cell]:
    """Returns the cells of the start: two rows, the first four those of [FORM], west of them."""
    behind = ((-1 - k // 2, 0) if k % 2 == 0 else (-2 - k // 2, 1) for k in itertools.count())
    return [(0, 0), (-1, 1), (1, 0), (0, 1), *itertools.islice(behind, robots - LEAST_ROBOTS)]


def _next_move(
    cells: Sequence[Cell], point: Point, side: float
) -> tuple[int, Cell, tuple[Cell, Cell, Cell]] | None:
    """Returns the mover, its target and the cells of its beacons; None if no move goes nearer."""
    far = [_distance(cell, point, side) for cell in cells]
    for mover in sorted(range(len(cells)), key=lambda k: -far[k]):
        others = set(cells) - {cells[mover]}
        if not _stands(others):
            continue
        here = _position(cells[mover], side)
        targets = _targets(others)
        ranks = {
            cell: (_distance(cell, point, side), _distance(cell, here, side), cell)
            for cell in targets
        }
        target = min(targets, key=ranks.__getitem__)
        if ranks[target][0] < far[mover]:
            return mover, target, targets[target]
    return None


def _triangles(cells: set[Cell]) -> Iterator[tuple[Cell, Cell, Cell]]:
    """Yields each triangle three times, each of its corners last and seen from beyond the edge.

    The first two are the left and the right one of a robot that stands beyond, facing away.
    """
    for anchor in cells:
        for k in range(6):
            right, left = _add(anchor, _AROUND[k]), _add(anchor, _AROUND[(k + 1) % 6])
            if right in cells and left in cells:
                yield left, right, anchor


def _targets(cells: set[Cell]) -> dict[Cell, tuple[Cell, Cell, Cell]]:
    """Returns the free cells that a triangle's corner is mirrored to, with that triangle."""
    found: dict[Cell, tuple[Cell, Cell, Cell]] = {}
    for left, right, anchor in sorted(_triangles(cells)):
        target = (left[0] + right[0] - anchor[0], left[1] + right[1] - anchor[1])
        if target not in cells:
            found.setdefault(target, (left, right, anchor))
    return found


def _stands(cells: set[Cell]) -> bool:
    """Returns whether all robots stand in triangles that are joined by common edges."""
    left = {frozenset(triangle) for triangle in _triangles(cells)}
    if not left:
        return False
    reached = [left.pop()]
    for triangle in reached:
        joined = {other for other in left if len(other & triangle) == 2}
        left -= joined
        reached += joined
    return set().union(*reached) == cells


def _drive_length(mover: Cell, target: Cell, beacons: Sequence[Cell], side: float) -> float:
    centres = [
        _position(((a + c) / 2, (b + d) / 2), side)
        for (a, b), (c, d) in itertools.combinations(beacons, 2)
        if (c - a, d - b) in _AROUND
    ]
    start, end = _position(mover, side), _position(target, side)
    leave = min(centres, key=lambda centre: math.dist(centre, start))
    arrive = min(centres, key=lambda centre: math.dist(centre, end))
    return math.dist(start, leave) + math.dist(leave, arrive) + math.dist(arrive, end)


def _add(a: Cell, b: Cell) -> Cell:
    return a[0] + b[0], a[1] + b[1]


def _position(cell: tuple[float, float], side: float) -> Point:
    """Returns the position of a cell in W, m; that of the first robot's start is (side / 2, 0)."""
    return side * (cell[0] + cell[1] / 2 + 0.5), side * cell[1] * _HEIGHT


def _distance(cell: Cell, point: Point, side: float) -> float:
    """Returns a distance in sides, rounded: equal ones shall be equal, not decided by rounding."""
    return round(math.dist(_position(cell, side), point) / side, 9)
