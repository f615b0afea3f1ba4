"""What a formation does next, whatever has happened to its robots: one look after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from systems.messages import Message
from systems.planners.formation_ground import FormationParameters, Ground, past
from systems.planners.formation_lattice import TriangleLattice, Vertex, body_of
from systems.planners.formation_moves import (
    Forbidden,
    Formation,
    Move,
    formation_of,
    in_reach,
)
from systems.planners.formation_obstacles import Obstacles, clearance
from systems.planners.polyline import rest_of

Array = NDArray[np.float64]
Rule = Callable[[Formation, Array, Ground, Forbidden], Move | None]


@dataclass(frozen=True, eq=False)
class FormationMove(Message):
    """What a formation is to do now.

    Attributes:
        stamp: when it was planned, s; NaN before the first plan.
        frame_id: the frame of the places.
        status: `waiting` (nothing is planned yet), `moving` (one robot is to move), `reached` (a
            robot stands at the destination), `blocked` (no move leads there, for now), `broken` (a
            beacon stands far from its vertex) or `too_few_robots` (less than four can move, or no
            three of them make a triangle).
        number: of the move, counted from 1; 0 before the first.
        mover: number of the robot that is to move; -1 when none is.
        beacons: (3,) numbers of beacons 1, 2 and 3, as `systems.formation.triangles` lists them;
            -1 when there is no move.
        target: (2,) the vertex to build, m; NaN when there is no move.
        points: (n, 2) the mover's way: centre points between beacons, the last one that of beacons
            1 and 2, then the target; m.
        leader: the robot that bids best to lead, the beacon nearest to the destination; -1 when
            there is none. Every robot can work the plan out; this says whose is meant to count.
    """

    stamp: float = math.nan
    frame_id: str = ""
    status: str = "waiting"
    number: int = 0
    mover: int = -1
    beacons: NDArray[np.int64] = field(default_factory=lambda: np.full(3, -1))
    target: Array = field(default_factory=lambda: np.full(2, math.nan))
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    leader: int = -1


@dataclass(frozen=True, eq=False)
class Memory(Message):
    """What a planner keeps from one look to the next.

    Attributes:
        vertices: of the robots that stand at one, by number.
        move: what was said last.
        target: the vertex that the present move is to.
        fixed: robots that cannot move, and still mark the vertex that they stand at.
        wrecks: where other robots have failed, (2,) m each, by number; NaN where it is not known.
        given_up: (robot, vertex) since the last move that succeeded.
        unplaced: moves so far that were said to be done, by robots that were not found afterwards.
        been: sets of vertices that were taken since something else changed.
        destination: (2,) m, and
        obstacles: for which the last plan was made.
    """

    vertices: Mapping[int, Vertex]
    move: FormationMove = field(default_factory=FormationMove)
    target: Vertex | None = None
    fixed: frozenset[int] = frozenset()
    wrecks: Mapping[int, Array] = field(default_factory=dict)
    given_up: frozenset[tuple[int, Vertex]] = frozenset()
    unplaced: int = 0
    been: frozenset[frozenset[Vertex]] = frozenset()
    destination: Array = field(default_factory=lambda: np.full(2, math.nan))
    obstacles: Obstacles = field(default_factory=Obstacles)


@dataclass(frozen=True, eq=False)
class Report:
    """What a planner is told at one look.

    Attributes:
        time: s.
        positions: (n, 2) of all robots, estimated, m; NaN where one is not known.
        failed: (n,) 0 for a robot that is able, 1 for one that cannot move, 2 for one that is no
            beacon either.
        obstacles: known or sensed.
        destination: (2,) m.
        outcome: of the present move: 0 under way, 1 done, -1 given up.
    """

    time: float
    positions: Array
    failed: NDArray[np.int64]
    obstacles: Obstacles
    destination: Array
    outcome: int = 0


def after(
    memory: Memory,
    report: Report,
    lattice: TriangleLattice,
    parameters: FormationParameters,
    rule: Rule,
) -> Memory:
    """Returns what a planner keeps, and says, after a look.

    A move goes on until it is done or given up, the mover or one of its beacons fails, or an
    obstacle turns up in the rest of its way or between its target and a beacon. Then, and when a
    formation that stands is told of another destination, obstacle or failure, the next move is
    planned.
    """
    # As it mostly is, while a robot is on its way.
    if _is_as_before(memory, report) and not _is_broken(
        memory.vertices, report.positions, lattice, parameters
    ):
        return memory
    vertices, wrecks, given_up = dict(memory.vertices), dict(memory.wrecks), memory.given_up
    move = memory.move
    unplaced = report.outcome > 0 and not np.isfinite(report.positions[move.mover]).all()
    under_way = move.status == "moving"
    if under_way and memory.target is not None and report.outcome != 0:
        under_way = False
        if report.outcome > 0 and not unplaced:
            vertices[move.mover] = memory.target
            given_up = frozenset()
        else:
            given_up |= {(move.mover, memory.target)}
    # Who fails on the way marks no vertex: that is a wreck too.
    failed = {k: int(report.failed[k]) for k in map(int, np.flatnonzero(report.failed))}
    fixed = frozenset(k for k in failed if failed[k] == 1 and k in vertices)
    new_wrecks = [k for k in failed if k not in fixed and k not in wrecks]
    for k in new_wrecks:
        place = report.positions[k]
        if not np.isfinite(place).all():
            place = lattice.positions(vertices[k]) if k in vertices else move.target
        wrecks[k] = np.array(place)
        vertices.pop(k, None)
        under_way = under_way and k != move.mover and k not in move.beacons
    other_obstacles = report.obstacles is not memory.obstacles
    if under_way and other_obstacles:
        under_way = not _is_cut(move, report, parameters)
    kept = replace(
        memory,
        vertices=vertices,
        fixed=(memory.fixed | fixed) - wrecks.keys(),
        wrecks=wrecks,
        given_up=given_up,
        unplaced=memory.unplaced + (unplaced and memory.target is not None),
        destination=report.destination if not under_way else memory.destination,
        obstacles=report.obstacles,
    )
    changed = (
        bool(new_wrecks)
        or kept.fixed != memory.fixed
        or other_obstacles
        or report.outcome < 0
        or unplaced
        or not np.array_equal(report.destination, memory.destination)
    )
    if changed:
        kept = replace(kept, been=frozenset())
    broken = _is_broken(vertices, report.positions, lattice, parameters)
    if broken and move.status != "broken":
        return replace(kept, move=_standing(move, "broken", report.time), target=None)
    if under_way or broken or not (changed or move.status in ("waiting", "moving")):
        return kept
    return _planned(kept, report, lattice, parameters, rule)


def _is_as_before(memory: Memory, report: Report) -> bool:
    """Whether a move is under way, and nothing is reported that could end it."""
    return (
        memory.move.status == "moving"
        and report.outcome == 0
        and report.obstacles is memory.obstacles
        and not report.failed.any()
        and np.array_equal(report.destination, memory.destination)
    )


def _is_cut(move: FormationMove, report: Report, parameters: FormationParameters) -> bool:
    position = report.positions[move.mover]
    if not np.isfinite(position).all():
        return False
    end = past(move.points[-2], move.points[-1], parameters.beyond)
    points = np.concatenate([move.points[:-1], end[None]])
    rest = np.concatenate([position[None], rest_of(points, position)])
    # Planned with the whole safety zone, given up at half of it: noise must not turn robots back.
    room = parameters.robot_radius + parameters.safety / 2
    if any(clearance(report.obstacles, a, b) < room for a, b in pairwise(rest)):
        return True
    beacons = report.positions[move.beacons]
    seen = (b for b in beacons if np.isfinite(b).all())
    margin = parameters.sight_margin / 2
    return any(clearance(report.obstacles, move.target, b) < margin for b in seen)


def _is_broken(
    vertices: Mapping[int, Vertex],
    positions: Array,
    lattice: TriangleLattice,
    parameters: FormationParameters,
) -> bool:
    names = sorted(vertices)
    places = lattice.positions(np.array([vertices[k] for k in names], float).reshape(-1, 2))
    off = np.hypot(*(positions[names] - places).T)
    return bool((off > parameters.tolerance * parameters.side).any())  # not for NaN


def _standing(move: FormationMove, status: str, time: float, leader: int = -1) -> FormationMove:
    return FormationMove(
        stamp=time, frame_id=move.frame_id, status=status, number=move.number, leader=leader
    )


def _planned(
    memory: Memory,
    report: Report,
    lattice: TriangleLattice,
    parameters: FormationParameters,
    rule: Rule,
) -> Memory:
    """Returns the memory with the next move, or with what there is to say instead."""
    positions, destination = report.positions, report.destination
    able = [k for k in range(len(positions)) if k not in memory.wrecks and k not in memory.fixed]
    if len(able) < 4 or not body_of(list(memory.vertices.values())):
        move = _standing(memory.move, "too_few_robots", report.time)
        return replace(memory, move=move, target=None)
    places = {
        k: lattice.positions(memory.vertices[k]) if k in memory.vertices else positions[k]
        for k in able
    }
    known = {k: p for k, p in places.items() if np.isfinite(p).all()}
    formation = formation_of(memory.vertices, known, memory.fixed)
    wrecks = [place for place in memory.wrecks.values() if np.isfinite(place).all()]
    wrecks += [lattice.positions(memory.vertices[k]) for k in memory.fixed - formation.fixed]
    apart = {
        k: (float(np.hypot(*(lattice.positions(v) - destination)).round(9)), k)
        for k, v in formation.standing.items()
        if k not in memory.fixed
    }
    leader = min(apart, key=apart.__getitem__, default=-1)
    if in_reach(formation, destination, Ground(lattice, report.obstacles, parameters)):
        move = _standing(memory.move, "reached", report.time, leader)
        return replace(memory, move=move, target=None)
    been = memory.been | {formation.places_of_able()}
    found = None
    # A wreck may close the way through the triangles: then others drive around them.
    for around in (False, True)[: 1 + bool(wrecks)]:
        for given_up in dict.fromkeys((memory.given_up, frozenset())):
            forbidden = Forbidden(given_up, been)
            found = found or _first_move(
                formation, wrecks, report, lattice, parameters, rule, forbidden, around
            )
    if found is None:
        move = _standing(memory.move, "blocked", report.time, leader)
        return replace(memory, move=move, target=None)
    number_of = {v: k for k, v in formation.standing.items()}
    move = FormationMove(
        stamp=report.time,
        frame_id=memory.move.frame_id,
        status="moving",
        number=memory.move.number + 1,
        mover=found.mover,
        beacons=np.array([number_of[v] for v in found.beacons]),
        target=found.points[-1].copy(),
        points=found.points,
        leader=min((k for k in apart if k != found.mover), key=apart.__getitem__, default=-1),
    )
    staying = {k: v for k, v in memory.vertices.items() if k != found.mover}
    return replace(memory, vertices=staying, been=been, move=move, target=found.target)


def _first_move(
    formation: Formation,
    wrecks: list[Array],
    report: Report,
    lattice: TriangleLattice,
    parameters: FormationParameters,
    rule: Rule,
    forbidden: Forbidden,
    around: bool,
) -> Move | None:
    """Returns the move of a stray, the farthest first, or else of one of the formation.

    Whoever stands beside the formation is an obstacle for all others.
    """
    strays = formation.strays
    far = {k: float(np.hypot(*(p - report.destination))) for k, p in strays.items()}
    for mover in [*sorted(far, key=lambda k: (-far[k], k)), None]:
        in_the_way = [*wrecks, *(p for k, p in strays.items() if k != mover)]
        circles = [[*place, parameters.robot_radius] for place in in_the_way]
        obstacles = report.obstacles.with_circles(circles)
        ground = Ground(lattice, obstacles, parameters, around=around)
        alone = {} if mover is None else {mover: strays[mover]}
        if len(formation.standing) + len(alone) < 4:
            continue
        here = Formation(formation.standing, alone, formation.fixed)
        move = rule(here, report.destination, ground, forbidden)
        if move is not None and mover in (None, move.mover):
            return move
    return None
