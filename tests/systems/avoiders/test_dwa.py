from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from systems.avoiders.base import Hull, View
from systems.avoiders.dwa import (
    DwaParameters,
    choose,
    contact_times,
    distance_outside,
    dynamic_window,
    poses_on_arcs,
    seen_from,
    straight_room,
    thinned,
    with_room,
)

P = DwaParameters()
HULL = Hull(0.11, 0.09, 0.0975)  # not quite symmetric, so that front and rear cannot be mixed up


def view(points: np.ndarray, **changes: Any) -> View:
    values = {
        "now": 0.0,
        "pose": np.zeros(3),
        "goal": np.array([3.0, 0.0]),
        "twist": np.array([0.25, 0.0]),
    }
    return View(points=points.reshape(-1, 2), **{**values, **changes})


def wall(x: float, y_min: float, y_max: float) -> np.ndarray:
    y = np.arange(y_min, y_max + 1e-9, 0.02)
    return np.stack([np.full_like(y, x), y], axis=1)


def test_the_window_is_what_the_limits_let_it_reach() -> None:
    v, omega = dynamic_window(np.array([0.2, 1.0]), P)
    assert v.min() == pytest.approx(0.2 - 0.6 * 0.25)
    assert v.max() == 0.3  # not 0.35
    assert omega.min() == pytest.approx(0.0)  # 1.0 - 4.0 * 0.25
    assert omega.max() == 1.5
    assert len(v) == len(omega) == P.speeds * P.turn_rates
    v, omega = dynamic_window(np.array([0.02, 0.3]), P)
    assert v.min() == 0.0  # it has no reverse
    assert (omega == 0.0).sum() == P.speeds


def test_poses_on_arcs_follow_the_unicycle() -> None:
    random = np.random.default_rng(1)
    v, omega, t = random.uniform(0, 0.3, 20), random.uniform(-2, 2, 20), random.uniform(0, 2, 20)
    omega[0] = 0.0
    n = 20000
    x, y, theta = np.zeros((3, 20))
    for _ in range(n):
        middle = theta + omega * t / n / 2
        x, y = x + v * t / n * np.cos(middle), y + v * t / n * np.sin(middle)
        theta = theta + omega * t / n
    np.testing.assert_allclose(poses_on_arcs(v, omega, t), (x, y, theta), atol=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_contact_times_agree_with_a_simulation(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform(-0.6, 0.6, (5, 2))
    points = points[distance_outside(points, HULL) > 0.01]
    v = np.append(random.uniform(0, 0.3, 12), [0.0, 0.0, 0.3])
    omega = np.append(random.uniform(-2, 2, 12), [1.0, -1.0, 0.0])
    found = contact_times(points, HULL, v, omega)
    dt = 0.002
    for k in range(len(v)):
        t = np.arange(0, 2.0, dt)
        seen = seen_from(
            points, *poses_on_arcs(np.full_like(t, v[k]), np.full_like(t, omega[k]), t)
        )
        x, y = seen[..., 0], seen[..., 1]
        inside = (x < HULL.front) & (x > -HULL.rear) & (np.abs(y) < HULL.half_width)
        hit = inside.any(axis=1)
        if hit.any():
            assert found[k] == pytest.approx(t[np.argmax(hit)], abs=2 * dt)
        else:
            assert found[k] > 2.0 - 2 * dt


def test_contact_by_hand() -> None:
    v, omega = np.array([0.2, 0.0, 0.0]), np.array([0.0, 1.0, -1.0])
    ahead = np.array([[0.51, 0.05]])
    assert contact_times(ahead, HULL, v, omega)[0] == pytest.approx(2.0, rel=1e-3)
    assert np.isinf(contact_times(ahead, HULL, v, omega)[1:]).all()
    # A point just off the left side near the front: turning left meets it with the front corner's
    # side at once, turning right much later with the rear.
    beside = np.array([[0.10, 0.10]])
    _, left, right = contact_times(beside, HULL, v, omega)
    assert left < 0.1 or right < 0.1
    assert contact_times(np.array([[0.0, 0.0]]), HULL, v, omega).tolist() == [0.0] * 3
    assert np.isinf(contact_times(np.zeros((0, 2)), HULL, v, omega)).all()


def test_distance_outside_by_hand() -> None:
    points = np.array([[0.21, 0.0], [-0.19, 0.0], [0.0, 0.1975], [0.14, 0.1375], [0.05, 0.05]])
    np.testing.assert_allclose(distance_outside(points, HULL), [0.1, 0.1, 0.1, 0.05, 0.0])


def test_straight_room_by_hand() -> None:
    points = np.array([[1.0, 0.05], [0.5, 0.2]])
    poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, math.pi / 2], [0.5, 0.0, -math.pi / 2]]).T
    np.testing.assert_allclose(straight_room(points, HULL, *poses), [0.89, 0.09, math.inf])


def test_thinning_keeps_the_nearest_of_each_direction() -> None:
    points = np.array([[0.5, 0.001], [0.3, 0.001], [0.0, 0.4], [-3.0, 0.1]])
    kept = {tuple(p) for p in thinned(points, 1.0)}
    assert kept == {(0.3, 0.001), (0.0, 0.4)}


def test_room_gives_way_to_what_is_near() -> None:
    assert with_room(np.array([[2.0, 2.0]]), HULL, 0.06).half_width == pytest.approx(0.1575)
    # Ahead also what the corners swing out.
    assert with_room(np.array([[2.0, 0.0]]), HULL, 0.06).front == pytest.approx(HULL.radius + 0.06)
    for points in ([[0.14, 0.0]], [[0.2, 0.05]], [[0.0, 0.12]], [[0.12, 0.12]]):
        room = with_room(np.array(points), HULL, 0.06)
        assert distance_outside(np.array(points), room)[0] > 0
        assert room.front >= HULL.front


def test_it_drives_straight_to_the_goal_at_full_speed_when_nothing_is_in_the_way() -> None:
    choice = choose(view(wall(1.0, 0.5, 1.5)), P, HULL)
    assert choice.clear
    np.testing.assert_array_equal(choice.local_goal, [3.0, 0.0])
    np.testing.assert_allclose(choice.command, [0.3, 0.0])


def test_every_command_leaves_room_to_stop() -> None:
    random = np.random.default_rng(5)
    driven = 0
    for _ in range(60):
        points = random.uniform(-0.8, 0.8, (8, 2))
        points = points[distance_outside(points, HULL) > 0.03]
        twist = np.array([random.uniform(0, 0.3), random.uniform(-1, 1)])
        choice = choose(view(points, twist=twist), P, HULL)
        v, omega = choice.command
        if choice.bearing is None or v == 0:
            continue
        driven += 1
        # Reaction at full speed, then braking along the same arc.
        t = np.linspace(0, P.reaction_time + max(v / 0.6, abs(omega) / 4.0) / 2, 100)
        seen = seen_from(points, *poses_on_arcs(np.full(100, v), np.full(100, omega), t))
        assert distance_outside(seen, HULL).min() > 0
    assert driven > 20


def test_on_the_spot_it_turns_toward_the_goal_only() -> None:
    """Else it may turn to and fro for ever, between two windows that each prefer the other."""
    random = np.random.default_rng(6)
    turned = 0
    for _ in range(300):
        points = random.uniform(-0.5, 0.5, (12, 2))
        points = points[distance_outside(points, HULL) > 0.04]
        goal = random.uniform(-1.0, 1.0, 2)
        twist = np.array([0.0, random.uniform(-0.3, 0.3)])
        choice = choose(view(points, goal=goal, twist=twist), P, HULL)
        if choice.bearing is None or choice.command[0] >= P.least_speed:
            continue
        turned += 1
        assert choice.command[1] * math.atan2(goal[1], goal[0]) > 0
    assert turned > 10


def test_it_slows_down_before_a_wall() -> None:
    speeds = []
    for x in (1.0, 0.45, 0.35, 0.28):
        ahead = view(wall(x, -1.5, 1.5), twist=np.array([0.15, 0.0]))
        speeds.append(choose(ahead, P, HULL).command[0])
    assert speeds[0] > speeds[-1]
    assert speeds[-1] < 0.1


def test_no_arc_is_free_before_the_bumper() -> None:
    choice = choose(view(wall(0.16, -1.0, 1.0), twist=np.zeros(2)), P, HULL)
    assert choice.bearing is None
    assert not choice.free.any()


def test_turning_in_place_is_offered_only_where_the_corners_pass() -> None:
    # One point at 0.145 m, within the corners' circle of 0.147 m: reached after a while.
    ring = 0.2 * np.stack([np.cos(np.arange(60) / 9.5), np.sin(np.arange(60) / 9.5)], axis=1)
    assert choose(view(ring, twist=np.zeros(2)), P, HULL).turns.tolist() == [1.5, 1.5]
    corners = np.array([[0.11, 0.1], [-0.09, 0.1], [0.11, -0.1], [-0.09, -0.1], [0.12, 0.0]])
    caged = np.concatenate([ring, corners])
    assert choose(view(caged, twist=np.zeros(2)), P, HULL).turns.tolist() == [0.0, 0.0]


def test_what_stands_behind_the_goal_does_not_matter() -> None:
    goal = np.array([0.5, 0.0])
    choice = choose(view(wall(0.85, -1, 1), goal=goal), P, HULL)
    assert choice.clear
    np.testing.assert_array_equal(choice.local_goal, goal)
    assert choice.command[0] > 0.2
    assert not choose(view(wall(0.85, -1, 1)), P, HULL).clear


def test_it_stops_at_the_goal() -> None:
    choice = choose(view(np.zeros((0, 2)), goal=np.array([0.01, 0.0])), P, HULL)
    np.testing.assert_array_equal(choice.command, [0.0, 0.0])
    assert choice.clear


@pytest.mark.parametrize("seed", range(15))
def test_the_mirror_image_gives_the_mirrored_command(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform(-1.2, 1.2, (15, 2))
    points = points[distance_outside(points, HULL) > 0.05]
    goal, twist, flip = np.array([2.0, 0.713]), np.array([0.2, 0.1]), np.array([1.0, -1.0])
    one = choose(view(points, goal=goal, twist=twist), P, HULL)
    other = choose(view(points * flip, goal=goal * flip, twist=twist * flip), P, HULL)
    np.testing.assert_allclose(other.command, one.command * flip, atol=1e-9)
    np.testing.assert_array_equal(other.free, one.free[::-1])


def test_the_command_does_not_depend_on_where_the_map_lies() -> None:
    points = np.array([[0.6, 0.1], [0.5, -0.4]])
    c, s = math.cos(2.1), math.sin(2.1)
    one = choose(view(points, goal=np.array([2.0, 0.5])), P, HULL)
    goal = np.array([7 + 2 * c - 0.5 * s, -3 + 2 * s + 0.5 * c])
    other = choose(view(points, pose=np.array([7.0, -3.0, 2.1]), goal=goal), P, HULL)
    np.testing.assert_allclose(other.command, one.command, atol=1e-12)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_speed", 0.0),
        ("max_turn_rate", math.nan),
        ("max_acceleration", -1.0),
        ("max_turn_acceleration", 0.0),
        ("window_time", 0.0),
        ("reaction_time", -0.1),
        ("margin", -0.01),
        ("comfort", 0.0),
        ("speeds", 1),
        ("turn_rates", 20),
        ("preview", 0.0),
        ("look_ahead", 0.0),
        ("slow_down", 0.0),
        ("heading_weight", -1.0),
        ("least_speed", 0.3),
        ("comfort_weight", math.inf),
    ],
)
def test_bad_parameters_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match="must be"):
        DwaParameters(**{field: value})
