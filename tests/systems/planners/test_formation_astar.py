from __future__ import annotations

import math

import numpy as np
import pytest

from plants.formation_arena import formation_arena, known_obstacles
from plants.planar_shapes import PlanarShapes
from systems.planners.formation_astar import astar_move, shortest_walk
from systems.planners.formation_ground import FormationParameters, Ground
from systems.planners.formation_lattice import fit_lattice, strip
from systems.planners.formation_moves import Forbidden, Formation, closest_vertex_move
from systems.planners.formation_obstacles import Obstacles
from tests.systems.planners.formations import FREE, PARAMETERS, fewest_moves, travel

START = strip(4, 1.5)
# A pocket that opens to the west, the formation in it, and the destination behind its end.
POCKET = [((-2.0, 4.5), (7.0, 4.5)), ((-2.0, -3.5), (7.0, -3.5)), ((7.0, -3.5), (7.0, 4.5))]
BEYOND = np.array([10.0, 0.5])


def walls(lines: list[tuple[tuple[float, float], tuple[float, float]]]) -> PlanarShapes:
    ends = np.array(lines)
    along = ends[:, 1] - ends[:, 0]
    lengths = np.hypot(*along.T)
    return PlanarShapes(
        centres=ends.mean(axis=1),
        headings=np.arctan2(along[:, 1], along[:, 0]),
        sizes=np.stack([lengths, np.full(len(ends), 0.1)], axis=1),
        radii=np.zeros(len(ends)),
    )


def test_it_leaves_a_dead_end_that_the_rule_stays_in() -> None:
    pocket = walls(POCKET)
    obstacles = Obstacles(polygons=pocket.corners())
    assert travel(closest_vertex_move, START, BEYOND, obstacles)[0] == "blocked"
    outcome, moves = travel(astar_move, START, BEYOND, obstacles)
    assert outcome == "reached"
    assert min(move.points[-1][0] for move in moves) < -2.0  # out by the open end
    best = fewest_moves(START, BEYOND, pocket, PARAMETERS.room)
    assert len(moves) == best


@pytest.mark.parametrize("robots", [5, 6, 12])
def test_a_snake_leaves_it_too(robots: int) -> None:
    obstacles = Obstacles(polygons=walls(POCKET).corners())
    places = strip(robots, 1.5)
    places = places - [max(0.0, places[:, 0].max() - 4.0), 0.0]
    outcome, moves = travel(astar_move, places, BEYOND, obstacles)
    assert outcome == "reached"
    # Once it knows its way it never turns: the walk is as long as it was said to be at first.
    lattice, vertices = fit_lattice(places, 1.5)
    walk = shortest_walk(frozenset(vertices), BEYOND, Ground(lattice, obstacles, PARAMETERS))
    assert walk is not None
    assert len(moves) == len(walk.vertices)


@pytest.mark.parametrize("robots", [4, 6, 12, 20])
def test_any_number_gets_anywhere(robots: int) -> None:
    random = np.random.default_rng(robots)
    for _ in range(5):
        destination = random.uniform(-10, 10, 2)
        assert travel(astar_move, strip(robots, 1.5), destination)[0] == "reached"


def test_in_the_open_it_needs_no_more_moves_than_a_search_of_everything() -> None:
    random = np.random.default_rng(5)
    far_away = PlanarShapes(centres=[[99, 99]], headings=[0], sizes=[[0, 0]], radii=[0.1])
    for _ in range(6):
        destination = random.uniform(-5, 5, 2)
        outcome, moves = travel(astar_move, START, destination)
        assert outcome == "reached"
        assert len(moves) == fewest_moves(START, destination, far_away, PARAMETERS.room)
        rule = travel(closest_vertex_move, START, destination)[1]
        assert len(moves) <= len(rule)


def test_the_walk_looks_at_the_way_inside_a_triangle() -> None:
    # A thin post before the pivot: of all lines of the way ahead only that between two centre
    # points of the second triangle comes near it.
    posts = [(2.25, 0.43)]
    shapes = PlanarShapes(centres=posts, headings=[0], sizes=[[0, 0]], radii=[0.01])
    obstacles = Obstacles(circles=np.array([[*post, 0.01] for post in posts]))
    destination = np.array([9.0, 0.65])
    lattice, vertices = fit_lattice(START, 1.5)
    ground = Ground(lattice, obstacles, PARAMETERS)
    walk = shortest_walk(frozenset(vertices), destination, ground)
    assert walk is not None
    outcome, moves = travel(astar_move, START, destination, obstacles)
    assert outcome == "reached"
    assert len(moves) == len(walk.vertices)
    assert len(moves) == fewest_moves(START, destination, shapes, PARAMETERS.room)
    assert len(moves) > len(travel(astar_move, START, destination)[1])


@pytest.mark.parametrize("seed", range(8))
def test_in_clutter_too(seed: int) -> None:
    made = formation_arena(seed)
    covered = made.arena.footprints()
    obstacles = known_obstacles(made.arena)
    outcome, moves = travel(astar_move, made.start, made.destination, obstacles)
    assert outcome == "reached"
    # The other search looks at points a centimetre apart, so a hair's breadth decides otherwise.
    easier, harder = (
        fewest_moves(made.start, made.destination, covered, PARAMETERS.room + slack)
        for slack in (-1e-3, 1e-3)
    )
    assert easier is not None
    assert easier <= len(moves) <= (harder or math.inf)


def test_fifty_cluttered_arenas() -> None:
    by_the_rule = 0
    for seed in range(50):
        made = formation_arena(seed)
        obstacles = known_obstacles(made.arena)
        outcome, moves = travel(astar_move, made.start, made.destination, obstacles)
        assert outcome == "reached", f"seed {seed}"
        assert len(moves) <= len(made.way) - 2, "longer than the hidden way"
        by_the_rule += (
            travel(closest_vertex_move, made.start, made.destination, obstacles)[0] == "reached"
        )
    assert 10 <= by_the_rule <= 40  # else they are no clutter, or no fair ones


def test_a_destination_that_is_walled_in_is_given_up() -> None:
    ring = walls([((6, -2), (10, -2)), ((10, -2), (10, 2)), ((10, 2), (6, 2)), ((6, 2), (6, -2))])
    outside = walls(
        [((-9, -9), (13, -9)), ((13, -9), (13, 9)), ((13, 9), (-9, 9)), ((-9, 9), (-9, -9))]
    )
    shapes = PlanarShapes.joined([ring, outside])
    obstacles = Obstacles(polygons=shapes.corners())
    assert travel(astar_move, START, np.array([8.0, 0.0]), obstacles) == ("blocked", [])
    assert fewest_moves(START, np.array([8.0, 0.0]), shapes, PARAMETERS.room) is None


def test_an_endless_search_ends() -> None:
    lattice, vertices = fit_lattice(START, 1.5)
    ground = Ground(lattice, FREE, FormationParameters(max_expansions=3))
    assert shortest_walk(frozenset(vertices), np.array([30.0, 0.0]), ground) is None
    more = Ground(lattice, FREE, PARAMETERS)
    assert shortest_walk(frozenset(vertices), np.array([30.0, 0.0]), more) is not None


def test_a_first_step_that_nobody_can_make_is_made_elsewhere() -> None:
    lattice, found = fit_lattice(START, 1.5)
    formation = Formation(dict(enumerate(found)), {})
    ground = Ground(lattice, FREE, PARAMETERS)
    destination = np.array([20.0, 0.65])
    move = astar_move(formation, destination, ground)
    assert move is not None
    taken = frozenset(v for k, v in enumerate(found) if k != move.mover) | {move.target}
    for forbidden in (
        Forbidden(moves=frozenset({(move.mover, move.target)})),
        Forbidden(places=frozenset({taken})),
    ):
        other = astar_move(formation, destination, ground, forbidden)
        assert other is not None
        assert (other.mover, other.target) != (move.mover, move.target)
