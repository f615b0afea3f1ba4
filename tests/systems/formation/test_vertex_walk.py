from __future__ import annotations

import math

import numpy as np
import pytest

from systems.formation.vertex_walk import VertexWalk, closest_vertex_walk

PAPERS_START = [(0.75, 0.0), (0.0, 1.30), (2.25, 0.0), (1.5, 1.30)]
SQRT3 = math.sqrt(3)


def test_start_is_the_papers() -> None:
    walk = closest_vertex_walk([(9.0, 0.65)])
    np.testing.assert_allclose(walk.start, PAPERS_START, atol=0.001)  # it rounds 1.299 to 1.30


@pytest.mark.parametrize(
    ("destination", "mover", "vertex", "beacons"),
    [  # the four directions of Fig. 4, by hand; beacons: left, right, anchor
        ((30.0, 0.65), 1, (3.0, 1.299), (3, 2, 0)),
        ((-30.0, 0.65), 2, (-0.75, 0.0), (0, 1, 3)),
        ((1.1, 30.0), 2, (0.75, 2.598), (1, 3, 0)),
        ((1.2, -30.0), 1, (1.5, -1.299), (2, 0, 3)),
    ],
)
def test_first_move(
    destination: tuple[float, float],
    mover: int,
    vertex: tuple[float, float],
    beacons: tuple[int, int, int],
) -> None:
    walk = closest_vertex_walk([destination])
    assert walk.movers[0] == mover
    np.testing.assert_allclose(walk.vertices[0], vertex, atol=0.001)
    assert tuple(walk.beacons[0]) == beacons
    # The way of Algorithm II: from a tip of the rhombus to the middle of one side of the triangle,
    # half a side on to the middle of the next, and out again.
    assert walk.drives[0] == pytest.approx(1.5 * (SQRT3 / 2 + 1 / 2 + SQRT3 / 2))


def test_along_a_strip_the_last_goes_first() -> None:
    walk = closest_vertex_walk([(30.0, 0.65)])
    assert walk.movers[:8].tolist() == [1, 0, 3, 2, 1, 0, 3, 2]
    np.testing.assert_allclose(np.diff(walk.vertices[:, 0]), 0.75)
    np.testing.assert_allclose(walk.vertices[::2, 1], 1.5 * SQRT3 / 2)
    np.testing.assert_allclose(walk.vertices[1::2, 1], 0.0, atol=1e-12)


def replayed(walk: VertexWalk) -> None:
    """Follows the robots, and holds each move to what a move is."""
    at = walk.start.copy()
    side = walk.side
    for k in range(len(walk)):
        mover, (left, right, anchor), vertex = walk.movers[k], walk.beacons[k], walk.vertices[k]
        assert len({mover, left, right, anchor}) == 4
        for a, b in ((left, right), (right, anchor), (anchor, left)):
            assert math.dist(at[a], at[b]) == pytest.approx(side)
        assert math.dist(vertex, at[left]) == pytest.approx(side)
        assert math.dist(vertex, at[right]) == pytest.approx(side)
        forward = vertex - at[anchor]
        assert math.hypot(*forward) == pytest.approx(SQRT3 * side)
        to_left = at[left] - at[right]
        assert forward[0] * to_left[1] - forward[1] * to_left[0] > 0
        np.testing.assert_allclose(walk.axes()[k, 1], forward / (SQRT3 * side), atol=1e-12)
        np.testing.assert_allclose(walk.axes()[k, 0], to_left / side, atol=1e-12)
        distances = np.linalg.norm(at - vertex, axis=1)
        assert distances.min() > 0.99 * side  # a free vertex
        expected = np.flatnonzero((np.abs(distances - side) < 1e-9) & (np.arange(len(at)) != mover))
        assert walk.neighbours[k].tolist() == expected.tolist()
        assert walk.drives[k] >= math.dist(at[mover], vertex) - 1e-9
        at[mover] = vertex


@pytest.mark.parametrize("robots", [4, 5, 6, 12, 20])
def test_every_move_is_one(robots: int) -> None:
    random = np.random.default_rng(robots)
    waypoints = np.cumsum(random.uniform([8, -3], [14, 9], (4, 2)), axis=0)
    walk = closest_vertex_walk(waypoints, robots=robots)
    assert len(walk.start) == robots
    replayed(walk)
    passed = [np.linalg.norm(walk.vertices - point, axis=1).min() for point in waypoints]
    assert max(passed) <= walk.side / SQRT3 + 1e-9
    assert math.dist(walk.vertices[-1], waypoints[-1]) <= walk.side / SQRT3 + 1e-9


def test_the_papers_paths_take_as_many_moves_as_its_errors_need() -> None:
    laps = closest_vertex_walk(4 * [(12, 0), (12, 6), (0, 6), (0, 0)])
    rectangle = closest_vertex_walk([(6.125, 0.65), (6.125, 3.65), (1.125, 3.65), (1.125, 0.65)])
    replayed(laps)
    replayed(rectangle)
    assert 160 <= len(laps) <= 200
    assert len(rectangle) == 15


def test_turned_by_half() -> None:
    # The start is its own picture, turned half around its middle: so must be the moves.
    middle = np.array([1.125, 1.5 * SQRT3 / 4])
    waypoints = np.array([[7.3, 2.1], [5.2, -6.7], [-4.4, 1.9]])
    walk = closest_vertex_walk(waypoints)
    turned = closest_vertex_walk(2 * middle - waypoints)
    np.testing.assert_allclose(turned.vertices, 2 * middle - walk.vertices, atol=1e-9)
    assert turned.movers.tolist() == [[3, 2, 1, 0][k] for k in walk.movers]


def test_scaled() -> None:
    waypoints = np.array([[7.3, 2.1], [5.2, -6.7]])
    walk = closest_vertex_walk(waypoints)
    double = closest_vertex_walk(2 * waypoints, side=3.0)
    assert double.movers.tolist() == walk.movers.tolist()
    np.testing.assert_allclose(double.vertices, 2 * walk.vertices)
    np.testing.assert_allclose(double.drives, 2 * walk.drives)
    np.testing.assert_allclose(double.times(speed=0.2), 2 * walk.times(speed=0.2))


def test_times() -> None:
    walk = closest_vertex_walk([(9.0, 0.65)])
    times = walk.times(speed=0.5, build_speed=0.2, build_way=0.4)
    np.testing.assert_allclose(np.diff(times, prepend=0.0), walk.drives / 0.5 + 2.0)


def test_the_rule_that_cannot_says_so() -> None:
    # A snake of 12 robots that bites its tail.
    around = [(6.125, 0.65), (6.125, 3.65), (1.125, 3.65), (1.125, 0.65)]
    with pytest.raises(ValueError, match=r"12 robots never reaches the waypoint \(1\.125, 0\.65\)"):
        closest_vertex_walk(around, robots=12)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"robots": 3}, "robots is 3: must be 4 or more"),
        ({"side": 0.0}, "side is 0.0: must be greater than 0"),
        ({"waypoints": [1.0, 2.0]}, "waypoints is"),
        ({"waypoints": [[1.0, math.nan]]}, "waypoints is"),
    ],
)
def test_refused(arguments: dict[str, object], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        closest_vertex_walk(**{"waypoints": [(9.0, 0.65)], **arguments})  # type: ignore[arg-type]


def test_refused_speed() -> None:
    with pytest.raises(ValueError, match="speed is -1: must be greater than 0"):
        closest_vertex_walk([(9.0, 0.65)]).times(speed=-1)
