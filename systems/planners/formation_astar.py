"""The way of a formation through clutter: A* over its moves, which leaves dead ends.

A formation goes from triangle to triangle: with a triangle of beacons, the mover goes to the mirror
image of one of them in the side of the others, and that side and the new vertex are the next
triangle. So its ways are walks on triangles that share sides, each step with the lines that the
step after it needs. With four robots these walks are all that there is, and the one found has the
fewest moves: the state is the beacons' triangle and where the mover stands, the triangle before.

With more robots the formation is a snake whose head follows the walk; it may sprout anywhere. Every
move puts a robot at the walk's next vertex and leaves the triangle that the walk starts from, so
the walk of the next plan is shorter by one. Where nobody can make the first step, as what is behind
is closed to the rest of the snake, another walk is taken; that it does not come back and do so for
ever, `FormationPlanner` forbids the places that have been taken.

Hart, Nilsson, Raphael, "A formal basis for the heuristic determination of minimum cost paths", IEEE
Transactions on Systems Science and Cybernetics 4, 1968.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.planners.formation_ground import Ground, corner, middle
from systems.planners.formation_lattice import (
    Triangle,
    Vertex,
    mirrored,
    sides_of,
    triangles_of,
)
from systems.planners.formation_moves import (
    NOTHING,
    Forbidden,
    Formation,
    Move,
    candidates,
    move_to,
)

Array = NDArray[np.float64]
_State = tuple[Triangle | None, Triangle]


class Walk(NamedTuple):
    """A way to the destination.

    Attributes:
        start: the triangle of the formation that it starts from.
        vertices: those to be taken, one a move.
    """

    start: Triangle
    vertices: list[Vertex]


def shortest_walk(
    body: frozenset[Vertex],
    destination: Array,
    ground: Ground,
    refused: frozenset[tuple[Triangle, Vertex]] = frozenset(),
) -> Walk | None:
    """Returns the walk with the fewest moves that puts a robot at the destination.

    Args:
        body: the vertices that the formation has.
        destination: (2,) m.
        ground: which lines are free.
        refused: first steps (triangle, vertex) that nobody can make.

    Returns:
        None when there is none, or none was found within the parameters' `max_expansions`.
    """
    p = ground.parameters
    step = p.side / math.sqrt(3)  # from centre to centre of triangles, and to their corners
    reach = p.arrival * p.side

    def to_go(triangle: Triangle) -> int:
        centre = ground.lattice.positions(np.mean([*triangle], axis=0))
        return max(0, math.ceil((np.hypot(*(centre - destination)) - reach) / step - 1 - 1e-9))

    def there(vertex: Vertex) -> bool:
        return bool(np.hypot(*(ground.place(corner(vertex)) - destination)) <= reach + 1e-9)

    heap: list[tuple[int, int, int, _State]] = []
    spent: dict[_State, int] = {}
    parents: dict[_State, _State] = {}
    closed: set[_State] = set()

    def offer(state: _State, moves: int) -> None:
        if moves < spent.get(state, math.inf):
            spent[state] = moves
            # Of equal states the one that has come farther; then the older, so that runs repeat.
            heappush(heap, (moves + to_go(state[1]), -moves, len(heap) + len(closed), state))

    for triangle in triangles_of(body):
        offer((None, triangle), 0)
    while heap and len(closed) < p.max_expansions:
        state = heappop(heap)[3]
        if state in closed:
            continue
        closed.add(state)
        if state[0] is not None and there(_taken(state)):
            return _walk(state, parents)
        for ahead in _steps(state, body, ground):
            following: _State = (state[1], ahead)
            if state[0] is None and (state[1], _taken(following)) in refused:
                continue
            if spent[state] + 1 < spent.get(following, math.inf):
                parents[following] = state
                offer(following, spent[state] + 1)
    return None


def _taken(state: _State) -> Vertex:
    """Returns the vertex that the last step took."""
    before, here = state
    (vertex,) = here - (before or frozenset())
    return vertex


def _walk(state: _State, parents: dict[_State, _State]) -> Walk:
    vertices = []
    while state[0] is not None:
        vertices.append(_taken(state))
        state = parents[state]
    return Walk(state[1], vertices[::-1])


def _steps(state: _State, body: frozenset[Vertex], ground: Ground) -> Iterator[Triangle]:
    """Yields the triangles that a step leads to.

    Of a first step only the end is looked at: by which way the mover comes is not known yet.
    """
    before, here = state
    entry = None
    if before is not None:
        (left,) = before - here
        entry = middle(*sorted(before & here))
        if not ground.can_drive(corner(left), entry):
            return
    for p, q, r in sides_of(here):
        leaving, target = middle(p, q), mirrored(r, p, q)
        if leaving == entry or (before is None and target in body):
            continue
        if (entry is None or ground.can_drive(entry, leaving)) and ground.can_build(p, q, r):
            yield frozenset({p, q, target})


def astar_move(
    formation: Formation,
    destination: Array,
    ground: Ground,
    forbidden: Forbidden = NOTHING,
) -> Move | None:
    """Returns the first move of the way with the fewest moves.

    The mover is a stray, or else the robot that is farthest from where the walk starts, counted in
    sides of triangles.

    Args:
        formation: who stands where.
        destination: (2,) m.
        ground: which lines are free.
        forbidden: what is not to be tried.

    Returns:
        None when there is no way, or none was found.
    """
    body = frozenset(formation.standing.values())
    ordered = list(candidates(formation, destination, ground))
    refused: frozenset[tuple[Triangle, Vertex]] = frozenset()
    while (walk := shortest_walk(body, destination, ground, refused)) is not None:
        target = walk.vertices[0]
        hops = _hops(body, walk.start)
        farthest = sorted(
            (k for k in ordered if formation.standing.get(k) not in walk.start),
            key=lambda k: -hops[formation.standing[k]] if k in formation.standing else -math.inf,
        )
        for mover in farthest:
            if forbidden.allows(formation, mover, target):
                move = move_to(formation, mover, target, ground)
                if move is not None:
                    return move
        refused |= {(walk.start, target)}
    return None


def _hops(body: frozenset[Vertex], start: Triangle) -> dict[Vertex, int]:
    """Returns how many sides each vertex is from a triangle, along triangles of the body."""
    triangles = triangles_of(body)
    hops = dict.fromkeys(start, 0)
    front = set(start)
    while front:
        near = {v for t in triangles if t & front for v in t} - set(hops)
        step = 1 + max(hops.values())
        hops |= dict.fromkeys(near, step)
        front = near
    return hops
