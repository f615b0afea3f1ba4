from __future__ import annotations

import math

import numpy as np
import pytest

from systems.planners.formation_ground import FormationParameters, Ground
from systems.planners.formation_lattice import Vertex, strip
from systems.planners.formation_moves import (
    Formation,
    candidates,
    closest_vertex_move,
    formation_of,
    in_reach,
    move_to,
    targets_of,
)
from systems.planners.formation_obstacles import Obstacles
from tests.systems.planners.formations import FREE, PARAMETERS, formation_at, travel

H = 1.5 * math.sqrt(0.75)  # height of a triangle
START = strip(4, 1.5)  # (0.75, 0), (0, H), (2.25, 0), (1.5, H)
TRANSFORMS = [np.eye(2), np.diag([1.0, -1.0]), np.diag([-1.0, 1.0]), np.array([[0.0, -1], [1, 0]])]


def turned(transform: np.ndarray, *points: tuple[float, float]) -> np.ndarray:
    return np.array(points) @ transform.T


def ground_of(places: np.ndarray, obstacles: Obstacles = FREE) -> tuple[Formation, Ground]:
    formation, lattice = formation_at(places)
    return formation, Ground(lattice, obstacles, PARAMETERS)


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize(
    ("destination", "mover", "target"),
    [  # the four directions of Fig. 4: two ends of the rhombus, to two vertices each
        ((20.0, 0.65), 1, (3.0, H)),
        ((-20.0, 0.65), 2, (-0.75, 0.0)),
        ((10.0, -18.0), 1, (1.5, -H)),
        ((-8.0, 19.0), 2, (0.75, 2 * H)),
    ],
)
def test_the_farthest_robot_goes_to_the_vertex_nearest_by(
    transform: np.ndarray,
    destination: tuple[float, float],
    mover: int,
    target: tuple[float, float],
) -> None:
    # In a mirror image, and turned, it is the mirror image of the move.
    places = START @ transform.T
    (goal,) = turned(transform, destination)
    formation, ground = ground_of(places)
    move = closest_vertex_move(formation, goal, ground)
    assert move is not None
    assert move.mover == mover
    np.testing.assert_allclose(move.points[-1], turned(transform, target)[0], atol=1e-9)


def test_the_points_of_algorithm_two_by_hand() -> None:
    formation, ground = ground_of(START)
    move = closest_vertex_move(formation, np.array([20.0, 0.65]), ground)
    assert move is not None
    # Beacons at (0.75, 0), (1.5, H), (2.25, 0): the centre point nearest to the robot at (0, H),
    # the one nearest to the vertex (3, H), the vertex.
    np.testing.assert_allclose(move.points, [[1.125, H / 2], [1.875, H / 2], [3.0, H]], atol=1e-9)
    beacons = ground.lattice.positions(np.array(move.beacons))
    np.testing.assert_allclose(beacons, [[2.25, 0], [1.5, H], [0.75, 0]], atol=1e-9)


def test_going_straight_on_takes_the_ends_in_turn() -> None:
    outcome, moves = travel(closest_vertex_move, START, np.array([12.0, 0.65]))
    assert outcome == "reached"
    # Each move takes a robot on by two sides, along x.
    ways = [move.points[-1] for move in moves]
    np.testing.assert_allclose(np.array(ways)[:3], [[3, H], [3.75, 0], [4.5, H]], atol=1e-9)
    assert [move.mover for move in moves[:5]] == [1, 0, 3, 2, 1]


@pytest.mark.parametrize("robots", [4, 5, 6, 7, 12, 20])
def test_any_number_gets_anywhere_by_legal_moves(robots: int) -> None:
    random = np.random.default_rng(robots)
    for _ in range(10):
        destination = random.uniform(-10, 10, 2)
        outcome, moves = travel(closest_vertex_move, strip(robots, 1.5), destination)
        assert outcome == "reached"
        last = moves[-1].points[-1] if moves else None
        assert last is None or np.hypot(*(last - destination)) <= 0.6 * 1.5


def test_an_obstacle_at_the_vertex_makes_it_the_next_nearest() -> None:
    goal = np.array([20.0, 0.65])
    formation, ground = ground_of(START, Obstacles(circles=np.array([[3.0, H, 0.2]])))
    move = closest_vertex_move(formation, goal, ground)
    assert move is not None
    assert move.mover == 1
    np.testing.assert_allclose(move.points[-1], [1.5, -H], atol=1e-9)


def test_an_obstacle_in_the_way_makes_it_another_robot() -> None:
    # It stands between the farthest robot and the first centre point: that robot cannot leave.
    goal = np.array([-3.0, -12.0])
    first = closest_vertex_move(*reordered(FREE, goal))
    assert first is not None
    assert first.mover == 1
    post = Obstacles(circles=np.array([[0.2, 1.18, 0.05]]))
    second = closest_vertex_move(*reordered(post, goal))
    assert second is not None
    assert second.mover == 2
    np.testing.assert_allclose(second.points[-1], [-0.75, 0.0], atol=1e-9)


def reordered(obstacles: Obstacles, goal: np.ndarray) -> tuple[Formation, np.ndarray, Ground]:
    formation, ground = ground_of(START, obstacles)
    return formation, goal, ground


@pytest.mark.parametrize("gap", [-0.01, 0.01])
def test_the_safety_zone_is_as_wide_as_said(gap: float) -> None:
    # Ahead of the last leg, which goes on past the vertex by as much as the robot does.
    radius, ahead = 0.3, np.array([math.cos(math.pi / 6), math.sin(math.pi / 6)])
    away = PARAMETERS.beyond + PARAMETERS.room + radius + gap
    circle = [*(np.array([3.0, H]) + away * ahead), radius]
    formation, ground = ground_of(START, Obstacles(circles=np.array([circle])))
    move = closest_vertex_move(formation, np.array([20.0, 0.65]), ground)
    assert move is not None
    assert np.allclose(move.points[-1], [3.0, H]) == (gap > 0)


@pytest.mark.parametrize("margin", [0.04, 0.06])
def test_a_beacon_must_be_seen_from_the_vertex(margin: float) -> None:
    # A thin post 5 cm off the line to beacon (1.5, H), out of the way of all robots.
    post = Obstacles(circles=np.array([[2.1, H + 0.06, 0.01]]))
    parameters = FormationParameters(sight_margin=margin)
    formation, lattice = formation_at(START)
    ground = Ground(lattice, post, parameters)
    move = closest_vertex_move(formation, np.array([20.0, 0.65]), ground)
    assert move is not None
    assert np.allclose(move.points[-1], [3.0, H]) == (margin < 0.05)


def test_a_dead_end_is_said() -> None:
    wall = Obstacles(polygons=np.array([[[4.2, -9.0], [4.4, -9.0], [4.4, 9.0], [4.2, 9.0]]]))
    outcome, moves = travel(closest_vertex_move, START, np.array([9.0, 0.6]), wall)
    assert outcome == "blocked"
    assert moves


def test_only_who_leaves_a_whole_may_leave() -> None:
    formation, ground = ground_of(START)
    assert list(candidates(formation, np.array([20.0, 0.65]), ground)) == [1, 2]
    six, ground = ground_of(strip(6, 1.5))
    assert sorted(candidates(six, np.array([20.0, 0.65]), ground)) == [2, 5]  # the strip's ends
    beacons = frozenset(formation.standing[k] for k in (0, 2, 3))
    places = ground.lattice.positions(np.array(sorted(targets_of(beacons))))
    expected = {(0.0, H), (3.0, H), (1.5, -H)}  # the mover's own place is free once it has left
    assert {(round(x, 6), round(y, 6)) for x, y in places} == {
        (round(x, 6), round(y, 6)) for x, y in expected
    }


def test_a_long_way_leads_through_every_triangle_between() -> None:
    formation, ground = ground_of(strip(8, 1.5))
    move = closest_vertex_move(formation, np.array([30.0, 0.65]), ground)
    assert move is not None
    assert move.mover == 7
    np.testing.assert_allclose(move.points[:-1, 1], H / 2, atol=1e-9)  # along the middle
    np.testing.assert_allclose(np.diff(move.points[:-1, 0]), 0.75, atol=1e-9)


def test_a_stray_comes_back_by_the_nearest_centre_point() -> None:
    formation, ground = ground_of(START)
    standing = {k: v for k, v in formation.standing.items() if k != 1}
    stray = formation_of(standing, {1: np.array([0.3, 1.0])} | dict.fromkeys(standing, np.zeros(2)))
    assert set(stray.strays) == {1}
    target = next(v for v in targets_of(stray.without(1)) if is_at(ground, v, 3.0))
    move = move_to(stray, 1, target, ground)
    assert move is not None
    np.testing.assert_allclose(move.points, [[1.125, H / 2], [1.875, H / 2], [3.0, H]], atol=1e-9)


def is_at(ground: Ground, vertex: Vertex, x: float) -> bool:
    return bool(abs(ground.lattice.positions(np.array(vertex))[0] - x) < 1e-6)


def test_arrival_is_within_the_said_part_of_a_side() -> None:
    formation, ground = ground_of(START)
    assert in_reach(formation, np.array([2.25 + 0.89, 0.0]), ground)
    assert not in_reach(formation, np.array([2.25 + 0.91, 0.0]), ground)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("side", 0.6),
        ("side", 0.0),
        ("robot_radius", -1.0),
        ("safety", math.nan),
        ("arrival", 0.5),
        ("tolerance", 0.0),
        ("max_expansions", 0),
    ],
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be"):
        FormationParameters(**{field: value})
