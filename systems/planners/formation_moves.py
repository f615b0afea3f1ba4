"""The next move of a formation: who leaves, to which vertex, by which way.

Source: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations" ([FORM]), 3: the robot farthest from the destination moves, to the free
vertex nearest to the destination, by way of the centre points between beacons (Algorithm II); where
an obstacle with its safety zone lies in the way it is the next nearest vertex, or another robot.

Ours, where the paper leaves it open. A robot may go only if all others still hang together by whole
triangles without it (with four robots: the two ends of the rhombus, each to two vertices, which are
the four directions of Fig. 4). The mover must come nearer to the destination than it stood: so the
sum of all distances falls with each move and the rule never goes round in circles, but ends, at the
destination or in a dead end. With more than three beacons the way leads from centre point to centre
point through the triangles, the shortest such way; with three it is that of Algorithm II.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from systems.planners.formation_ground import (
    Ground,
    Half,
    corner,
    middle,
)
from systems.planners.formation_lattice import (
    Vertex,
    bodies_of,
    mirrored,
    sides_of,
    triangles_of,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Move:
    """One robot's way to a new vertex.

    Attributes:
        mover: number of the robot.
        beacons: the vertices of beacons 1, 2 and 3 as `systems.formation.triangles` lists them: 1
            off the side by which the mover enters the last triangle, 2 the pivot, on that side and
            on the one by which it leaves, 3 the anchor, off the latter.
        target: the vertex to go to, mirror image of beacon 3 in the side of beacons 1 and 2.
        points: (n, 2) m, centre points to pass, and then the target; the last centre point is that
            of beacons 1 and 2.
    """

    mover: int
    beacons: tuple[Vertex, Vertex, Vertex]
    target: Vertex
    points: Array


@dataclass(frozen=True)
class Formation:
    """Who stands where.

    Attributes:
        standing: vertex of each robot of the formation: one body of triangles (see `bodies_of`).
        strays: place of each robot beside it that can move, (2,) m.
        fixed: those that stand and cannot move any more. They serve as beacons, and are left
            behind.
    """

    standing: Mapping[int, Vertex]
    strays: Mapping[int, Array]
    fixed: frozenset[int] = frozenset()

    def without(self, robot: int) -> frozenset[Vertex]:
        """Returns the vertices that hang together when a robot is away."""
        return _main_body({k: v for k, v in self.standing.items() if k != robot}, self.fixed)

    def places_of_able(self, away: int | None = None) -> frozenset[Vertex]:
        """Returns the vertices of those that can move, but for one that is away."""
        able = self.standing.keys() - self.fixed
        return frozenset(self.standing[k] for k in able if k != away)

    def can_leave(self, robot: int) -> bool:
        """Whether all others that can move hang together without a robot that can."""
        body = self.without(robot)
        together = len(body) >= 3 and self.places_of_able(robot) <= body
        return together and robot not in self.fixed


def _main_body(standing: Mapping[int, Vertex], fixed: frozenset[int]) -> frozenset[Vertex]:
    """Returns the body with the most robots that can move, and of those the largest."""
    able = {v for k, v in standing.items() if k not in fixed}
    return max(
        bodies_of(list(standing.values())),
        key=lambda body: (len(body & able), len(body)),
        default=frozenset(),
    )


def formation_of(
    vertices: Mapping[int, Vertex],
    places: Mapping[int, Array],
    fixed: frozenset[int] = frozenset(),
) -> Formation:
    """Returns the formation that some robots make: the main body, and the rest as strays.

    Args:
        vertices: of the robots that stand at one.
        places: of all that can move, (2,) m each; of those that stand too.
        fixed: those that stand and cannot move.
    """
    body = _main_body(vertices, fixed)
    standing = {k: v for k, v in vertices.items() if v in body}
    strays = {k: p for k, p in places.items() if k not in standing}
    return Formation(standing, strays, fixed & standing.keys())


@dataclass(frozen=True)
class Forbidden:
    """What is not to be tried.

    Attributes:
        moves: of a robot to a vertex.
        places: sets of vertices that the robots that can move are not to take again.
    """

    moves: frozenset[tuple[int, Vertex]] = frozenset()
    places: frozenset[frozenset[Vertex]] = frozenset()

    def allows(self, formation: Formation, mover: int, target: Vertex) -> bool:
        """Whether a robot may go to a vertex."""
        if (mover, target) in self.moves:
            return False
        return not self.places or formation.places_of_able(mover) | {target} not in self.places


NOTHING = Forbidden()


def targets_of(body: frozenset[Vertex]) -> set[Vertex]:
    """Returns the free vertices that complete a triangle with two beacons of a triangle."""
    faces = (side for triangle in triangles_of(body) for side in sides_of(triangle))
    return {mirrored(r, p, q) for p, q, r in faces} - body


def move_to(formation: Formation, mover: int, target: Vertex, ground: Ground) -> Move | None:
    """Returns the shortest way of a robot to a vertex through the triangles of all others.

    Args:
        formation: who stands where.
        mover: one that can leave, or a stray.
        target: a free vertex.
        ground: which lines are free.

    Returns:
        None when it has no room, does not see its beacons, or there is no way.
    """
    body = formation.without(mover)
    triangles = triangles_of(body)
    last: dict[Half, tuple[Vertex, Vertex, Vertex]] = {}
    links: dict[Half, list[Half]] = {}
    for triangle in triangles:
        sides = list(sides_of(triangle))
        points = [middle(p, q) for p, q, _ in sides]
        for k, (p, q, r) in enumerate(sides):
            links.setdefault(points[k], []).extend(points[:k] + points[k + 1 :])
            if mirrored(r, p, q) == target:
                last[points[k]] = (p, q, r)
    last = {point: pqr for point, pqr in last.items() if ground.can_build(*pqr)}
    if not last:
        return None
    start, entries = _entries(formation, mover, set(links), ground)
    found = _shortest(start, entries, links, set(last), ground)
    if found is None and ground.around:
        links = _links_around(formation, mover)
        if mover in formation.standing:
            entries = [corner(formation.standing[mover])]
        else:
            entries = _nearest_entry(start, set(links), ground)
        found = _shortest(start, entries, links, set(last), ground)
    if found is None:
        return None
    places = [ground.place(point) for point in (*found, corner(target))]
    p, q, r = last[found[-1]]
    before = places[-3] if len(found) > 1 else start
    if _apart(ground.place(corner(p)), before) < _apart(ground.place(corner(q)), before):
        p, q = q, p
    return Move(mover, (p, q, r), target, np.array(places))


def _entries(
    formation: Formation, mover: int, points: set[Half], ground: Ground
) -> tuple[Array, list[Half]]:
    """Returns where a robot is, and the centre points by which it can come into the triangles."""
    if mover in formation.standing:
        vertex = formation.standing[mover]
        body = formation.without(mover)
        near = [
            middle(p, q)
            for triangle in triangles_of(body)
            for p, q, r in sides_of(triangle)
            if mirrored(r, p, q) == vertex
        ]
        free = [point for point in near if ground.can_drive(corner(vertex), point)]
        return ground.place(corner(vertex)), free
    start = formation.strays[mover]
    return start, _nearest_entry(start, points, ground)


def _nearest_entry(start: Array, points: set[Half], ground: Ground) -> list[Half]:
    """Returns the nearest of some points that a robot can drive to from a place; empty for none."""
    for point in sorted(points, key=lambda p: (_apart(start, ground.place(p)), p)):
        if ground.can_drive_from(start, point):
            return [point]
    return []


def _links_around(formation: Formation, mover: int) -> dict[Half, list[Half]]:
    """Returns which points next to each other are free of robots, up to two sides around them.

    All lines between them are at least sqrt(3)/4 sides from every beacon.
    """
    taken = {corner(v) for k, v in formation.standing.items() if k != mover}
    span = range(-4, 5)
    points = {(i + di, j + dj) for i, j in taken for di in span for dj in span} - taken
    steps = ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))
    return {
        (i, j): [(i + di, j + dj) for di, dj in steps if (i + di, j + dj) in points]
        for i, j in points
    }


def _shortest(
    start: Array,
    entries: list[Half],
    links: Mapping[Half, list[Half]],
    goals: set[Half],
    ground: Ground,
) -> list[Half] | None:
    """Returns the centre points of the shortest way (Dijkstra); the last steps are all as long."""
    heap: list[tuple[float, Half, tuple[Half, ...]]] = []
    for point in sorted(entries):
        heappush(heap, (_apart(start, ground.place(point)), point, (point,)))
    done: set[Half] = set()
    while heap:
        length, here, way = heappop(heap)
        if here in goals:
            return list(way)
        if here in done:
            continue
        done.add(here)
        for there in links[here]:
            if there not in done and ground.can_drive(here, there):
                step = ground.lattice.side / 2
                heappush(heap, (round(length + step, 9), there, (*way, there)))
    return None


def _apart(a: Array, b: Array) -> float:
    return round(float(np.hypot(*(a - b))), 9)


def in_reach(formation: Formation, destination: Array, ground: Ground) -> bool:
    """Whether a robot of the formation that can move stands at the destination (2,) m."""
    reach = ground.parameters.arrival * ground.parameters.side
    distances = _distances(formation.places_of_able(), destination, ground)
    return min(distances.values(), default=math.inf) <= reach


def candidates(formation: Formation, destination: Array, ground: Ground) -> Iterator[int]:
    """Yields the robots that may move: strays first, and of either the farthest first."""
    apart = {k: _apart(p, destination) for k, p in formation.strays.items()}
    yield from sorted(apart, key=lambda k: (-apart[k], k))
    standing = formation.standing
    distances = _distances(standing.values(), destination, ground)
    for k in sorted(standing, key=lambda k: (-distances[standing[k]], k)):
        if formation.can_leave(k):
            yield k


def closest_vertex_move(
    formation: Formation,
    destination: Array,
    ground: Ground,
    forbidden: Forbidden = NOTHING,
) -> Move | None:
    """Returns the move of the paper's rule: the farthest robot, to the vertex nearest by.

    Args:
        formation: who stands where.
        destination: (2,) m.
        ground: which lines are free.
        forbidden: what is not to be tried.

    Returns:
        None in a dead end: no robot can come nearer to the destination than it stands.
    """
    taken = set(formation.standing.values())
    for mover in candidates(formation, destination, ground):
        free = targets_of(formation.without(mover)) - taken
        distances = _distances(free, destination, ground)
        stands = formation.standing.get(mover)
        limit = math.inf
        if stands is not None:
            limit = _distances([stands], destination, ground)[stands]
        for target in sorted(distances, key=lambda v: (distances[v], v)):
            if distances[target] >= limit:
                break
            if forbidden.allows(formation, mover, target):
                move = move_to(formation, mover, target, ground)
                if move is not None:
                    return move
    return None


def _distances(
    vertices: Iterable[Vertex], destination: Array, ground: Ground
) -> dict[Vertex, float]:
    """Returns how far vertices are from the destination, m, without the last digits."""
    names = list(vertices)
    places = ground.lattice.positions(np.array(names, float).reshape(-1, 2))
    lengths = np.hypot(*(places - destination).T).round(9)
    return dict(zip(names, lengths.tolist(), strict=True))
