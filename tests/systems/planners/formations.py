"""A formation that makes its moves at once, and a search of its own for what it could do."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable
from functools import cache

import numpy as np

from plants.planar_shapes import PlanarShapes
from systems.planners.formation_ground import FormationParameters, Ground
from systems.planners.formation_lattice import TriangleLattice, body_of, fit_lattice
from systems.planners.formation_moves import Formation, Move, formation_of, in_reach
from systems.planners.formation_obstacles import Obstacles, clearance

PARAMETERS = FormationParameters()
FREE = Obstacles()


def formation_at(places: np.ndarray, side: float = 1.5) -> tuple[Formation, TriangleLattice]:
    """The formation of robots at these places, and the lattice of the first."""
    lattice, vertices = fit_lattice(places, side)
    standing = dict(enumerate(vertices))
    return Formation(standing, {}), lattice


def check_move(formation: Formation, move: Move, ground: Ground, obstacles: Obstacles) -> None:
    """Asserts what every move must be, in places and not in vertices of the lattice."""
    p, lattice = ground.parameters, ground.lattice
    others = {v for k, v in formation.standing.items() if k != move.mover}
    assert set(move.beacons) <= others, "a beacon does not stand"
    assert len(set(move.beacons)) == 3
    assert move.target not in formation.standing.values()
    assert body_of(others) == others, "the others do not hold together"
    one, two, three = lattice.positions(np.array(move.beacons))
    target = lattice.positions(np.array(move.target))
    np.testing.assert_allclose(move.points[-1], target, atol=1e-9)
    np.testing.assert_allclose(move.points[-2], (one + two) / 2, atol=1e-9)
    for a, b in itertools.combinations([one, two, three], 2):
        assert math.isclose(np.linalg.norm(a - b), p.side, rel_tol=1e-9)
    for beacon in (one, two):
        assert math.isclose(np.linalg.norm(target - beacon), p.side, rel_tol=1e-9)
    # Ahead at the target is the anchor, 30 degrees to either side of it the others.
    assert math.isclose(np.linalg.norm(target - three), math.sqrt(3) * p.side, rel_tol=1e-9)
    if len(move.points) > 2:
        np.testing.assert_allclose(move.points[-3], (two + three) / 2, atol=1e-9)
    if move.mover in formation.standing:
        start = lattice.positions(np.array(formation.standing[move.mover]))
        way = [start, *move.points]
        for a, b in itertools.pairwise(way):
            assert clearance(obstacles, a, b) >= p.room
            for other in others:
                place = lattice.positions(np.array(other))
                off = clearance(Obstacles(circles=np.array([[*place, 0.0]])), a, b)
                assert off >= math.sqrt(3) / 4 * p.side - 1e-9, "too near to a beacon"
    ahead = (target - three) / np.linalg.norm(target - three)
    assert clearance(obstacles, target, target + p.beyond * ahead) >= p.room
    for beacon in (one, two, three):
        assert clearance(obstacles, target, beacon) >= p.sight_margin


def travel(
    rule: Callable[[Formation, np.ndarray, Ground], Move | None],
    places: np.ndarray,
    destination: np.ndarray,
    obstacles: Obstacles = FREE,
    parameters: FormationParameters = PARAMETERS,
    most: int = 300,
) -> tuple[str, list[Move]]:
    """Makes moves, each checked, until the formation is there or blocked."""
    lattice, found = fit_lattice(places, parameters.side)
    ground = Ground(lattice, obstacles, parameters)
    vertices = dict(enumerate(found))
    moves: list[Move] = []
    while len(moves) < most:
        formation = formation_of(vertices, {})
        if in_reach(formation, destination, ground):
            return "reached", moves
        move = rule(formation, destination, ground)
        if move is None:
            return "blocked", moves
        check_move(formation, move, ground, obstacles)
        vertices[move.mover] = move.target
        moves.append(move)
    return "endless", moves


def fewest_moves(
    places: np.ndarray,
    destination: np.ndarray,
    shapes: PlanarShapes,
    room: float,
    parameters: FormationParameters = PARAMETERS,
) -> int | None:
    """The fewest moves of four robots, by breadth-first search over where all of them stand.

    It shares nothing with the planner: places in the plane, moves as the paper says them, and what
    stands around looked at point by point.
    """
    side = parameters.side
    reach = parameters.arrival * side

    @cache
    def gap(a: complex, b: complex) -> float:
        n = max(2, round(abs(b - a) / 0.01))
        z = a + (b - a) * np.linspace(0, 1, n)
        return float(shapes.distances_from(np.stack([z.real, z.imag], axis=-1)).min())

    def free(a: complex, b: complex, needed: float) -> bool:
        return gap(*sorted((a, b), key=lambda z: (z.real, z.imag))) >= needed

    known: list[complex] = []

    def same_place(z: complex) -> complex:
        near = [other for other in known if abs(other - z) < 0.05]
        if not near:
            known.append(z)
        return near[0] if near else z

    def legal(mover: complex, beacons: tuple[complex, ...]) -> list[complex]:
        lengths = [abs(a - b) for a, b in itertools.combinations(beacons, 2)]
        if max(lengths) > side + 0.05 or min(lengths) < side - 0.05:
            return []
        middles = [(a + b) / 2 for a, b in itertools.combinations(beacons, 2)]
        found = []
        for anchor in beacons:
            one, two = (b for b in beacons if b != anchor)
            target = one + two - anchor
            if abs(target - mover) < 0.1:
                continue
            enter = min(middles, key=lambda m: abs(m - mover))
            leave = min(middles, key=lambda m: abs(m - target))
            past = target + parameters.beyond * (target - leave) / abs(target - leave)
            legs = [(mover, enter), (enter, leave), (leave, target), (target, past)]
            sights = [(target, beacon) for beacon in beacons]
            if all(free(a, b, room) for a, b in legs) and all(
                free(a, b, parameters.sight_margin) for a, b in sights
            ):
                found.append(same_place(target))
        return found

    goal = complex(*destination)
    first = frozenset(same_place(complex(*place)) for place in places)
    moves = {first: 0}
    queue = deque([first])
    while queue:
        state = queue.popleft()
        if min(abs(z - goal) for z in state) <= reach:
            return moves[state]
        for mover in state:
            beacons = tuple(sorted(state - {mover}, key=lambda z: (z.real, z.imag)))
            for target in legal(mover, beacons):
                following = frozenset({*beacons, target})
                if following not in moves:
                    moves[following] = moves[state] + 1
                    queue.append(following)
    return None
